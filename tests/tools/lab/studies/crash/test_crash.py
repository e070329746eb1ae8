"""`xrl study crash`: the matrix leaves nothing out, how a case is run, judged and shown."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from shared.bus.messages import Cause, JointEvent, Mode, RunEvent, RunEventKind
from shared.bus.traces import SimTruth
from shared.config import scenarios
from shared.config.robot_config import OPTIONAL, SERVICES, RobotConfig
from shared.config.scenarios import FAULT_KINDS, Fault, Kill
from shared.joints import MODULES
from shared.robot.fault_table import DRIVE_FAULTS
from tests.messages import filled, sample
from tests.tools.exit_codes import exit_code as exit_code_of
from tools.fleet.supervisor_client import ServiceInfo
from tools.lab.studies.crash import matrix
from tools.lab.studies.crash.cases import (
    BACK_S,
    CASES,
    CRASH_S,
    DURATION_S,
    HAND,
    REQUEST_S,
    CrashCase,
    CrashVerdict,
    scenario_of,
)
from tools.lab.studies.crash.matrix import (
    CASE_S,
    CrashMessages,
    CrashResult,
    exit_code,
    is_good,
    measure,
    row_of,
    select,
    show,
)
from tools.lab.studies.sweeps.table import Row
from tools.live.scenario_runner import ScenarioRunner, TriggeredKill
from tools.terminal import Console

BY_NAME = {case.name: case for case in CASES}
PLANNER = BY_NAME["kill-planner"]
KNEE = BY_NAME["kill-knee_left"]
ALONE = [case.crash[0] for case in CASES if len(case.crash) == 1 and case.triggered_kill is None]


def test_every_service_but_the_world_is_lost_alone_and_every_drive_has_these_faults_alone() -> None:
    lost = [(row.service, row.signal) for row in ALONE if isinstance(row, Kill)]
    services = set(SERVICES) - {"simulator", *OPTIONAL}
    assert set(lost) == set(product(services, ("KILL", "STOP")))
    faulted = {(row.module, row.kind) for row in ALONE if isinstance(row, Fault)}
    assert faulted >= set(product(MODULES, ("disarmed", "link_lost", "encoder")))


def test_every_kind_of_fault_is_tried() -> None:
    tried = {row.kind for case in CASES for row in case.crash if isinstance(row, Fault)}
    assert tried == set(FAULT_KINDS)


def test_pairs_all_joint_services_and_the_planner_coming_back_are_tried() -> None:
    assert sum(case.kind == "pair" and len(case.crash) == 2 for case in CASES) >= 10
    assert BY_NAME["kill-all-joints"].hit == set(MODULES)
    assert BY_NAME["kill-all-joints"].others == ()
    chased = [case.triggered_kill for case in CASES if case.triggered_kill is not None]
    assert {triggered_kill.service for triggered_kill in chased} == {"planner"}


def test_the_short_run_has_one_of_each_kind_in_five_minutes() -> None:
    quick = [case for case in CASES if case.quick]
    assert {case.kind for case in quick} == {case.kind for case in CASES}
    assert len(quick) * CASE_S <= 300.0


def test_names_are_their_own_and_can_be_folders() -> None:
    assert len(BY_NAME) == len(CASES)
    assert all(re.fullmatch(r"[a-z_-]+", name) for name in BY_NAME)


def test_any_one_process_that_dies_has_to_leave_the_robot_standing() -> None:
    deaths = [case for case in CASES if all(isinstance(row, Kill) for row in case.crash)]
    assert len(deaths) > 2 * (len(SERVICES) - 1)
    assert {case.expected for case in deaths} == {CrashVerdict.STOOD}


def test_a_robot_may_fall_only_where_a_module_is_limp() -> None:
    for case in CASES:
        limp = [r for r in case.crash if isinstance(r, Fault) and DRIVE_FAULTS[r.kind].limp]
        assert limp or case.expected is CrashVerdict.STOOD, case.name


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_case_is_a_scenario_that_asks_back_whatever_was_lost(case: CrashCase) -> None:
    scenario = scenario_of(case)
    scenarios.check(case.name, scenario)
    assert {row.service for row in scenario.restart if row.at == BACK_S} == case.hit
    assert case.why
    for row in scenario.fault:
        assert row.at + row.lasts_s < REQUEST_S, "over before it is asked for"


def test_the_crash_comes_on_the_way_down_and_the_pushes_before_the_request() -> None:
    scenario = scenario_of(BY_NAME["kill-planner"])
    hand = scenarios.lead(scenario, CRASH_S)
    assert hand.height == pytest.approx(1.0, abs=0.02)
    assert hand.height_rate < -0.05
    assert all(CRASH_S + 0.5 < push.at < REQUEST_S - 0.5 for push in scenario.push)


STOOD = CrashResult(verdict=CrashVerdict.STOOD, wall_s=13.0)
FELL = CrashResult(verdict=CrashVerdict.FELL, fell_after_s=0.7, wall_s=9.0)
SANK = CrashResult(verdict=CrashVerdict.SANK, sank_mm=60.0, wall_s=13.0)
LOST = CrashResult(verdict=CrashVerdict.UNJUDGED, remarks="no fleet")


def run_with(
    outcomes: list[CrashResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    robot: RobotConfig,
    case: CrashCase = PLANNER,
) -> tuple[CrashResult, list[Path]]:
    def once(case: CrashCase, robot: RobotConfig, out: Path, *rest: object) -> CrashResult:
        (out / "run.mcap").write_bytes(b"log")
        return outcomes.pop(0)

    monkeypatch.setattr(matrix, "_run_once", once)
    out = tmp_path / "case"
    return matrix.run_case(case, robot, out, print), list(out.glob("*.mcap"))


def test_a_disturbed_run_is_made_once_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotConfig
) -> None:
    late = msgspec.structs.replace(STOOD, in_real_time=False)
    for first in (late, LOST):
        done, _ = run_with([first, STOOD], tmp_path, monkeypatch, robot)
        assert (done.verdict, done.in_real_time, done.tries) == (CrashVerdict.STOOD, True, 2)
    done, _ = run_with([late, late, STOOD], tmp_path, monkeypatch, robot)
    assert (done.in_real_time, done.tries) == (False, 2)


def test_a_fall_is_not_tried_again_and_keeps_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, robot: RobotConfig
) -> None:
    for fell in (FELL, msgspec.structs.replace(FELL, in_real_time=False)):
        done, logs = run_with([fell, STOOD], tmp_path, monkeypatch, robot)
        assert (done.verdict, done.tries) == (CrashVerdict.FELL, 1)
        assert len(logs) == 1
    limp_ankle = BY_NAME["disarmed-ankle_left"]
    _, logs = run_with([FELL], tmp_path, monkeypatch, robot, limp_ankle)
    assert len(logs) == 1, "also where it is allowed"
    _, logs = run_with([STOOD], tmp_path, monkeypatch, robot)
    assert logs == []


def test_a_service_that_ends_by_itself_is_distinguished_from_one_that_was_killed() -> None:
    def service(name: str, *, up: bool, restarts: int = 0) -> ServiceInfo:
        return ServiceInfo(
            name=name,
            pid=7 if up else None,
            state="",
            uptime_s=1.0,
            restarts=restarts,
            last_exit="",
        )

    def done(kind: RunEventKind, name: str) -> RunEvent:
        return RunEvent(t_ns=1, seq=1, kind=int(kind), subject=name, detail="", scenario_s=1.0)

    killed, back = RunEventKind.KILLED, RunEventKind.RESTARTED
    events = [done(killed, "planner"), done(killed, "hip_left"), done(back, "hip_left")]
    as_told = [service("planner", up=False), service("hip_left", up=True, restarts=1)]
    assert matrix.died_of([*as_told, service("harness", up=True)], events) == []
    services = [service("harness", up=True, restarts=1), service("hip_left", up=False)]
    assert matrix.died_of(services, events) == ["harness", "hip_left"]


def test_what_is_chased_is_killed_once_as_the_modules_track_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session = SimpleNamespace(latest=lambda *_: None, publisher=lambda *_: None)
    scenario = scenario_of(BY_NAME["reengaging-first"])
    triggered_kill = TriggeredKill("planner", modules=2, after_s=0.0)
    conductor = ScenarioRunner(None, session, scenario, print, triggered_kill)  # type: ignore[arg-type]
    killed: list[object] = []
    monkeypatch.setattr(conductor, "_act", killed.append)
    for tracking, expected in ((6, 0), (3, 0), (0, 0), (1, 0), (2, 1), (6, 1)):
        conductor._modes = dict.fromkeys(MODULES[:tracking], int(Mode.TRACK))
        conductor._follow(2.0)
        assert len(killed) == expected, tracking
    assert killed == [Kill(service="planner", at=2.0)]


def result(case: CrashCase, done: CrashResult) -> Row:
    return {**row_of(case), **msgspec.structs.asdict(done)}


def test_the_exit_code_distinguishes_a_forbidden_fall_from_a_run_that_failed() -> None:
    stood, bad_fall = result(PLANNER, STOOD), result(KNEE, FELL)
    allowed_fall = result(BY_NAME["disarmed-ankle_left"], FELL)
    lost, sank = result(BY_NAME["kill-harness"], LOST), result(PLANNER, SANK)
    assert exit_code([stood, allowed_fall]) == 0
    assert exit_code([stood, lost]) == 2
    assert exit_code([lost, bad_fall]) == 1
    assert exit_code([lost, sank]) == 3, "it sank, and did not fall"
    assert exit_code([sank, bad_fall]) == 1


def test_the_table_fits_a_terminal_and_has_every_case() -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    full = CrashResult(
        verdict=CrashVerdict.STOOD, safe_ms=123.4, torque_step_nm=12.34, torque_step_back_nm=12.34,
        leads_again_s=1.23, com_x_mm=-123.0, com_y_mm=123.0,
    )  # fmt: skip
    show([result(case, full) for case in CASES], console)
    text = console.export_text()
    assert "…" not in text
    assert all(case.name in text for case in CASES)
    assert f"{len(CASES)} of {len(CASES)} as expected or better" in text


def test_cases_are_chosen_by_name_pattern_and_length() -> None:
    chosen = select(CASES, quick=False, only=["kill-planner", "disarmed-*"])
    assert [case.name for case in chosen[:2]] == ["kill-planner", "disarmed-ankle_right"]
    assert len(chosen) == 1 + len(MODULES)
    assert len(select(CASES, quick=True, only=["kill-*"])) < 6
    assert select(CASES, quick=False, only=()) == list(CASES)


def test_list_runs_nothing_and_names_every_case(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code_of(["study", "crash", "--list", "--out", tmp_path / "out"]) == 0
    printed = capsys.readouterr().out
    assert all(case.name in printed for case in CASES)
    assert not (tmp_path / "out").exists()


def test_an_interrupted_matrix_keeps_its_cases_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    outcomes = [STOOD, FELL]

    def run_case(*_: object, **__: object) -> CrashResult:
        if not outcomes:
            raise KeyboardInterrupt
        return outcomes.pop(0)

    monkeypatch.setattr(matrix, "run_case", run_case)
    words = ["study", "crash", "--only", "kill-*_right", "--out", tmp_path / "out"]
    assert exit_code_of(words) == 130
    assert "stopped; 2 of 3 cases are in" in " ".join(capsys.readouterr().out.split())
    outcomes += [STOOD]
    assert exit_code_of(words) == 1, "one of the first two fell"
    assert "2 of 3 as expected or better: 2 stood, 1 fell" in capsys.readouterr().out


def test_a_fleet_that_cannot_be_run_ends_the_matrix_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(matrix, "run_case", lambda *_, **__: LOST)
    assert exit_code_of(["study", "crash", "--quick", "--out", tmp_path / "out"]) == 2
    assert "3 cases in a row cannot be judged: no fleet" in capsys.readouterr().err


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
    assert measure(PLANNER, run, robot).remarks == "harness ended on its own"


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
