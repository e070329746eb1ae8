"""How a run of the crash matrix is judged, on runs made up for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import pytest

from shared.bus.messages import Cause, JointEvent, Mode, RunEvent, RunEventKind
from shared.bus.traces import SimTruth
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tests.messages import filled, sample
from tools.lab.studies.crash.cases import (
    BACK_S,
    CASES,
    CRASH_S,
    DURATION_S,
    HAND,
    CrashCase,
    CrashVerdict,
    scenario_of,
)
from tools.lab.studies.crash.matrix import CrashMessages, is_good, measure, row_of

BY_NAME = {case.name: case for case in CASES}
PLANNER = BY_NAME["kill-planner"]
KNEE = BY_NAME["kill-knee_left"]
HARNESS = BY_NAME["kill-harness"]
S = 1_000_000_000


AT_REST: SimTruth = filled(SimTruth, {bool: False, int: 0, float: 0.0})


def truth(t: float, **changes: object) -> SimTruth:
    height = scenarios.lead(scenario_of(PLANNER), t).height
    row = {
        "t_ns": round((t + 7.0) * S), "scenario_s": t, "com": (0.0, 0.0, 0.8),
        "torso": (0.0, 0.0, height), "real_time_factor": 1.0,
    }  # fmt: skip
    return msgspec.structs.replace(AT_REST, **(row | changes))


def change(
    t: float,
    module: str,
    before: Mode,
    after: Mode,
    step: float = 0.0,
    cause: Cause = Cause.HOLD_ALL,
) -> tuple[str, JointEvent]:
    event = sample(
        JointEvent,
        t_ns=round((t + 7.0) * S),
        mode_before=int(before),
        mode_after=int(after),
        cause=int(cause),
        tau_before=(1.0, 2.0),
        tau_after=(1.0, 2.0 - step),
    )
    return module, event


def said(t: float, kind: RunEventKind, subject: str = "planner") -> RunEvent:
    return RunEvent(
        t_ns=round((t + 7.0) * S), seq=1, kind=int(kind), subject=subject, detail="", scenario_s=t
    )


def holds(at: float = CRASH_S + 0.05, *, but: Sequence[str] = ()) -> list[tuple[str, JointEvent]]:
    return [change(at, name, Mode.TRACK, Mode.HOLD) for name in MODULES if name not in but]


def heard(
    case: CrashCase,
    events: Sequence[tuple[str, JointEvent]] = (),
    *,
    world: Callable[[float], SimTruth] = truth,
    end: float = DURATION_S,
    modes: str = "TTTTTT",
) -> CrashMessages:
    rows = [world(index / 100) for index in range(round(end * 100) + 1)]
    marks = [said(0.0, RunEventKind.STARTED)]
    scenario = scenario_of(case)
    marks += [said(row.at, RunEventKind.KILLED, row.service) for row in scenario.kill]
    marks += [said(row.at, RunEventKind.RESTARTED, row.service) for row in scenario.restart]
    return CrashMessages(rows, list(events), marks, tuple(modes))


def hip_left(t: float, before: Mode, after: Mode, **changes: Any) -> tuple[str, JointEvent]:
    return change(t, "hip_left", before, after, **changes)


NOT_ALL = holds(but=("hip_left", "knee_left"))


@pytest.mark.parametrize(
    ("case", "events", "safe_ms", "remarks"),
    [
        (PLANNER, holds(), 50.0, None),
        (KNEE, [*NOT_ALL, hip_left(2.47, Mode.TRACK, Mode.HOLD)], 70.0, None),
        (PLANNER, holds(at=1.0), 0.0, None),
        (KNEE, NOT_ALL, None, "not all of the other modules held"),
        (HARNESS, [], None, None),
        (HARNESS, [hip_left(2.5, Mode.TRACK, Mode.HOLD)], None, "left TRACK: hip_left"),
        (KNEE, [*holds(), hip_left(2.6, Mode.HOLD, Mode.FAULT)], 50.0,
         "hip_left went to FAULT"),
        *(
            (KNEE, [*NOT_ALL, hip_left(2.44, Mode.TRACK, Mode.HOLD, cause=cause)], 50.0,
             f"hip_left tripped: {cause.name}")
            for cause in (Cause.SHAKING, Cause.TORQUE_LIMIT, Cause.TOO_FAST)
        ),
    ],
    ids=["stood", "the slowest", "held already", "tracks on", "not needed", "disturbed", "fault",
         "shaking", "torque limit", "too fast"],
)  # fmt: skip
def test_safe_is_when_the_slowest_module_that_was_not_hit_holds_and_all_else_is_remarked(
    robot: RobotConfig,
    case: CrashCase,
    events: Sequence[tuple[str, JointEvent]],
    safe_ms: float | None,
    remarks: str | None,
) -> None:
    outcome = measure(case, heard(case, events), robot)
    assert outcome.safe_ms == (safe_ms if safe_ms is None else pytest.approx(safe_ms))
    assert outcome.remarks == remarks
    assert (outcome.verdict, outcome.in_real_time) == (CrashVerdict.STOOD, True)
    assert outcome.sank_mm == pytest.approx(0.0, abs=1e-9)


def test_a_fall_is_timed_from_the_crash(robot: RobotConfig) -> None:
    late = hip_left(4.5, Mode.HOLD, Mode.FAULT, step=115.6)
    run = heard(PLANNER, [*holds(), late], world=lambda t: truth(t, fallen=t >= 4.0), end=5.0)
    outcome = measure(PLANNER, run, robot)
    assert outcome.verdict is CrashVerdict.FELL
    assert (outcome.remarks, outcome.torque_step_back_nm) == (None, None), (
        "what follows is no answer"
    )
    assert outcome.fell_after_s == pytest.approx(4.0 - CRASH_S)
    assert not is_good(row_of(PLANNER) | msgspec.structs.asdict(outcome))


@pytest.mark.parametrize(
    ("depth", "verdict"), [(0.04, CrashVerdict.STOOD), (0.06, CrashVerdict.SANK)]
)
def test_a_robot_below_where_the_hand_ever_led_has_sunk(
    robot: RobotConfig, depth: float, verdict: CrashVerdict
) -> None:
    lowest = min(frame.height for frame in HAND)

    def world(t: float) -> SimTruth:
        height = lowest - depth if t > 6.0 else truth(t).torso[2]
        return truth(t, torso=(0.0, 0.0, height))

    outcome = measure(PLANNER, heard(PLANNER, holds(), world=world), robot)
    assert outcome.verdict is verdict
    assert outcome.sank_mm == pytest.approx(1e3 * depth, abs=0.1)


@pytest.mark.parametrize(
    "changes", [{"foot_left_tilt": 0.1}, {"com": (0.2, 0.0, 0.8)}, {"com": (0.0, -0.5, 0.8)}]
)
def test_a_robot_that_is_tipping_at_the_end_has_fallen(
    robot: RobotConfig, changes: dict[str, object]
) -> None:
    run = heard(PLANNER, holds(), world=lambda t: truth(t, **(changes if t > 7.9 else {})))
    assert measure(PLANNER, run, robot).verdict is CrashVerdict.FELL


def test_a_run_that_broke_off_is_not_judged(robot: RobotConfig) -> None:
    outcome = measure(PLANNER, heard(PLANNER, holds(), end=6.0), robot)
    assert outcome.verdict is CrashVerdict.UNJUDGED
    assert "6.0 s" in str(outcome.remarks)
    never = CrashMessages([truth(-1.0)], [], [], ("D",) * 6)
    assert measure(PLANNER, never, robot).verdict is CrashVerdict.UNJUDGED


@pytest.mark.parametrize("changes", [{"real_time_factor": 0.9}, {"late_s": 0.2}])
def test_a_run_on_a_machine_that_was_too_slow_is_marked(
    robot: RobotConfig, changes: dict[str, object]
) -> None:
    run = heard(PLANNER, holds(), world=lambda t: truth(t, **changes))
    assert not measure(PLANNER, run, robot).in_real_time


def test_a_service_that_ends_by_itself_is_remarked(robot: RobotConfig) -> None:
    run = heard(PLANNER, holds())._replace(died=["harness"])
    assert measure(PLANNER, run, robot).remarks == "harness ended by itself"


def test_the_torque_step_is_of_the_modules_that_were_not_hit(robot: RobotConfig) -> None:
    events = [
        change(2.45, name, Mode.TRACK, Mode.HOLD, step=9.0 if name in KNEE.hit else 0.5)
        for name in MODULES
    ]
    events.append(change(5.5, "knee_left", Mode.DISARMED, Mode.HOLD, step=3.0))
    outcome = measure(KNEE, heard(KNEE, events), robot)
    assert outcome.torque_step_nm == pytest.approx(0.5)
    assert outcome.torque_step_back_nm == pytest.approx(3.0)


def test_it_leads_again_when_the_last_module_tracks(robot: RobotConfig) -> None:
    times = (5.8, 6.1, 5.9, 5.8, 5.8, 5.8)
    back = [
        change(at, name, Mode.HOLD, Mode.TRACK) for at, name in zip(times, MODULES, strict=True)
    ]
    outcome = measure(PLANNER, heard(PLANNER, [*holds(), *back]), robot)
    assert outcome.leads_again_s == pytest.approx(6.1 - BACK_S)
    not_all = measure(PLANNER, heard(PLANNER, holds(), modes="TTTTTH"), robot)
    assert not_all.leads_again_s is None
    assert not_all.remarks == "does not lead again: TTTTTH"


def test_a_chase_is_timed_by_its_own_kill(robot: RobotConfig) -> None:
    case = BY_NAME["reengaging-blend"]
    run = heard(case, [*holds(at=0.9), *holds(at=2.35)])
    missed = measure(case, run, robot)
    assert missed.verdict is CrashVerdict.UNJUDGED
    run.actions.append(said(2.3, RunEventKind.KILLED))  # type: ignore[attr-defined]
    tracked = [change(2.1, name, Mode.HOLD, Mode.TRACK) for name in MODULES]
    run = run._replace(events=[*holds(at=0.9), *tracked, *holds(at=2.35)])
    assert measure(case, run, robot).safe_ms == pytest.approx(50.0)
