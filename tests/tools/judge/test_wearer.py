"""What a robot did for its wearer, by hand-made logs whose figures are known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import pytest

from shared.bus import topics
from shared.bus.messages import JointState, PlannerMode, PlannerStatus, Wrench
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.config.robot_config import GRAVITY
from shared.exceptions import RunError
from shared.joints import kind_of
from tests.messages import sample
from tests.robots import ROBOT
from tools.judge.wearer import (
    IDLE_MARGIN,
    PAUSE_MARGIN,
    RESTS_N,
    WearerFigures,
    merged_figures,
    thresholds_of,
    wearer_figures,
)
from tools.logs.run_log import NewestAt, RunLog

SPAN_S = 4.0
M_G = ROBOT.mass.payload * GRAVITY
UPRIGHT, CROUCHED, DEEP, RATE = 0.2, 0.5, 0.9, 0.1
"""Half a knee's angle, rad, and its rate, rad/s."""
Path = Callable[[float], float]


class MadeLog:
    """A robot whose knees fold to twice an angle over time, and the force of its wearer."""

    def __init__(
        self,
        force: Path,
        fold: Path = lambda _t: UPRIGHT,
        *,
        assist: float = 0.0,
        kg: float = 0.0,
        mode: PlannerMode = PlannerMode.LEADING,
        until_s: float = math.inf,
        span_s: float = SPAN_S,
    ) -> None:
        self.path = "made.mcap"
        ticks = [0.004 * tick for tick in range(round(span_s / 0.004) + 1)]
        angles = {"ankle": 1.0, "knee": -2.0, "hip": 1.0}
        self._until_ns = until_s * NS_PER_S
        self._states = {
            module: [
                sample(JointState, t_ns=round(t * NS_PER_S), q=(0.0, angles[kind] * fold(t)))
                for t in ticks
            ]
            for module, kind in ((name, kind_of(name)) for name in topics.MODULES)
        }
        reach = ROBOT.geometry.l1 + ROBOT.geometry.l2
        self._rows: dict[Topic, list[Any]] = {
            topics.PLANNER_STATUS: [
                sample(
                    PlannerStatus,
                    t_ns=round(t * NS_PER_S), mode=int(mode), wearer=0, p=(0.0,) * 6,
                    stance=(0.0,) * 6,
                    pdot=(0.0, 0.0, reach * (math.cos(fold(t + 1e-3)) - math.cos(fold(t))) * 1e3,
                          0.0, 0.0, 0.0),
                    assist_requested_n=assist, load=(kg, 0.0, 0.0),
                )
                for t in ticks
            ],
            topics.WRENCH: [
                sample(
                    Wrench, t_ns=round(t * NS_PER_S), valid=True,
                    force=(0.0, 0.0, force(t)), moment=(0.0, 0.0, 0.0),
                )
                for t in (0.005 * step for step in range(round(span_s / 0.005)))
            ],
        }  # fmt: skip

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        return self._states[module] if module else self._rows[topic]

    def newest(self, topic: Topic, module: str = "") -> NewestAt:
        return NewestAt(self.messages(topic, module))

    def holds(self, t_ns: int) -> bool:
        return t_ns < self._until_ns

    def figures(self) -> WearerFigures:
        found = wearer_figures(cast(RunLog, self), ROBOT)
        assert found is not None
        return found


@pytest.mark.parametrize(
    ("rests", "assist", "kg"), [(0.0, 0.0, 0.0), (80.0, 100.0, 0.0), (-50.0, 0.0, 2.0)]
)
def test_the_share_is_of_the_payload_and_the_assist(rests: float, assist: float, kg: float) -> None:
    found = MadeLog(lambda _t: -rests, assist=assist, kg=kg).figures().phases
    load = M_G + GRAVITY * kg
    assert set(found) == {"all", "stand"}
    assert found["all"].share == pytest.approx((load + rests) / (load + assist))
    assert found["all"].seconds == pytest.approx(SPAN_S, abs=0.01)


def squat(t: float) -> float:
    """Return the fold of a squat: down for a second, a second there, and up again."""
    down = (DEEP - UPRIGHT) * min(1.0, t)
    return UPRIGHT + down if t < 2.0 else DEEP - (DEEP - UPRIGHT) * min(1.0, t - 2.0)


def test_each_phase_of_a_squat_has_its_mean() -> None:
    loads = {"down": -10.0, "work": -100.0, "up": 20.0, "stand": 0.0}
    by_second = list(loads.values())
    found = MadeLog(lambda t: by_second[min(3, int(t))], squat).figures().phases
    for name, force in loads.items():
        assert found[name].seconds == pytest.approx(1.0, abs=0.1)
        assert found[name].carried_n == pytest.approx(M_G - force, abs=6.0)


def test_work_is_the_persons_alone() -> None:
    """A force with the motion works; the same against it is work of the robot on the person."""
    reach = ROBOT.geometry.l1 + ROBOT.geometry.l2
    sinks = reach * (math.cos(CROUCHED) - math.cos(CROUCHED + RATE * SPAN_S))
    for force, work in ((-30.0, 30.0 * sinks), (30.0, 0.0)):
        found = MadeLog(lambda _t, force=force: force, lambda t: CROUCHED + RATE * t).figures()
        assert found.work_j == pytest.approx(work, rel=0.02)


@pytest.mark.parametrize(("lasts_s", "counts"), [(0.03, True), (0.2, False)])
@pytest.mark.parametrize("size", [60.0, -60.0])
def test_only_a_short_blow_is_a_bump(size: float, lasts_s: float, counts: bool) -> None:
    found = MadeLog(lambda t: size if 1.0 <= t < 1.0 + lasts_s else 0.0).figures()
    assert found.force_peak_n == abs(size)
    assert found.bumps == int(counts)
    assert found.bump_peak_n == pytest.approx(abs(size) if counts else 0.0, rel=0.1)


def test_a_person_rests_who_weighs_on_a_robot_that_is_still() -> None:
    def force(t: float) -> float:
        return -1.5 * RESTS_N if t < 1.5 else -0.5 * RESTS_N

    assert MadeLog(force).figures().resting_s == pytest.approx(1.5, abs=0.02)
    moves = MadeLog(force, lambda t: CROUCHED + RATE * t).figures()
    assert moves.resting_s == 0.0


def test_the_figures_of_a_run_are_those_of_its_parts() -> None:
    whole = MadeLog(lambda t: -40.0 if t < 1.0 else 10.0, squat)
    first = MadeLog(lambda t: -40.0 if t < 1.0 else 10.0, squat, until_s=1.0).figures()
    found = wearer_figures(cast(RunLog, whole), ROBOT, from_ns=NS_PER_S)
    assert found is not None
    merged, at_once = merged_figures([first, found]), whole.figures()
    assert merged.phases["all"].carried_n == pytest.approx(
        at_once.phases["all"].carried_n, rel=1e-2
    )
    assert merged.force_rms_n == pytest.approx(at_once.force_rms_n, rel=1e-2)
    assert merged.work_j == pytest.approx(at_once.work_j, rel=0.05)
    assert merged.force_peak_n == at_once.force_peak_n


def test_without_a_planner_that_led_there_are_none() -> None:
    held = MadeLog(lambda _t: 0.0, mode=PlannerMode.ALIGNING)
    assert wearer_figures(cast(RunLog, held), ROBOT) is None


MINUTE_S = 22.0
PAUSE_S = 0.6


def minute(t: float) -> float:
    """Return the fold of three squats, 4 s each and with a pause at the turn, and a crouch."""
    if t >= 12.0:
        return UPRIGHT + (DEEP - UPRIGHT) * min(1.0, (t - 12.0) / 1.0)
    t %= 4.0
    rises = t - 1.0 - PAUSE_S
    return UPRIGHT + (DEEP - UPRIGHT) * max(0.0, min(1.0, t, 1.0 - rises))


def test_a_persons_thresholds_follow_from_how_they_squat_and_rest() -> None:
    """A pull before the robot moves belongs to the lead, and one of 20 ms opens nothing."""

    def force(t: float) -> float:
        if t > 12.0:
            return 80.0 if 16.0 <= t < 16.02 else 4.0
        return 18.0 if 1.4 <= t % 4.0 < 2.7 else -10.0

    found = thresholds_of(cast(RunLog, MadeLog(force, minute, span_s=MINUTE_S)), ROBOT)
    assert found.squats == 3
    assert found.thresholds.open_n == pytest.approx(18.0, abs=0.5)
    assert found.thresholds.still_s == pytest.approx(PAUSE_MARGIN * PAUSE_S, abs=0.15)
    assert found.thresholds.open_back_nm == ROBOT.park.open_back_nm
    assert not found.doubts


def test_a_person_who_pulls_harder_at_rest_than_they_lead_is_told_so() -> None:
    log = MadeLog(lambda t: 24.0 if t > 14.0 else 12.0, minute, span_s=MINUTE_S)
    found = thresholds_of(cast(RunLog, log), ROBOT)
    assert found.thresholds.open_n == pytest.approx(IDLE_MARGIN * 24.0, abs=0.5)
    assert "unpark on its own" in found.doubts[0]


def test_without_squats_and_a_rest_nothing_is_measured() -> None:
    with pytest.raises(RunError, match=r"squats: 0, .*crouch: 0 s, .*three times"):
        thresholds_of(cast(RunLog, MadeLog(lambda _t: 0.0)), ROBOT)
