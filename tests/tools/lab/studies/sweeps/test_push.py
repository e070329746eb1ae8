"""The push envelope: a grid that is what was asked for, a bisection, a picture with its limits."""

from __future__ import annotations

import math
import random
from typing import Any

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools.lab.studies.sweeps import push
from tools.lab.studies.sweeps.plants import PushRange
from tools.lab.studies.sweeps.push import PushTrial, limits_of, run_trial


def trials_of(**changes: Any) -> list[PushTrial]:
    return push.trials_of(push.PushStudyFlags(**changes))


def point(**changes: object) -> PushTrial:
    given: dict[str, object] = {
        "number": 0, "pose": "squat", "angle_deg": 90, "duration_s": 3.0, "mode": "dead",
    }  # fmt: skip
    return PushTrial(**(given | changes))  # type: ignore[arg-type]  # as the fields are


def test_the_grid_has_every_pose_duration_angle_and_mode_once() -> None:
    trials = trials_of()
    assert len(trials) == len({(t.pose, t.duration_s, t.angle_deg, t.mode) for t in trials})
    assert len(trials) == 3 * 2 * 5 * 2
    some = trials_of(pose=["crawl"], angle=[0, 90], duration=[1.0])
    assert {(t.pose, t.duration_s) for t in some} == {("crawl", 1.0)}
    assert [t.number for t in some] == list(range(4))


@pytest.mark.parametrize("falls_from", [3.0, 100.0, 1e9])
def test_the_bisection_finds_the_force_within_its_step(
    falls_from: float, robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(push, "_start_of", lambda *_: None)
    monkeypatch.setattr(push, "_stands", lambda _t, _r, _s, force: force < falls_from)
    outcome = run_trial(point(), robot)
    if falls_from > push.FORCE_MAX_N:
        assert outcome.fell_n is None
        assert outcome.stood_n >= push.FORCE_MAX_N - push.STEP_N
    else:
        assert outcome.fell_n is not None
        assert outcome.stood_n < falls_from <= outcome.fell_n
        assert outcome.fell_n - outcome.stood_n <= push.STEP_N


@pytest.mark.parametrize("pose", push.POSES)
@pytest.mark.parametrize("angle", push.ANGLES_DEG)
def test_no_mode_holds_more_than_the_body_bears(pose: str, angle: int, robot: RobotConfig) -> None:
    limits = limits_of(point(pose=pose, angle_deg=angle), robot)
    assert 0.0 < limits.held.force_n <= limits.body.force_n
    assert 0.0 < limits.drives.force_n <= limits.body.force_n


def test_a_robot_without_a_schedule_is_refused(robot: RobotConfig) -> None:
    with pytest.raises(RunError, match="xrl gains"):
        limits_of(point(), msgspec.structs.replace(robot, gain_schedule=None))


def test_with_the_planner_dead_a_lasting_push_from_the_side_is_stood(robot: RobotConfig) -> None:
    """30 N for 3 s made it fall; the certificate read 1.08."""
    trial = point(pose="stand")
    start = push._start_of(trial, robot)
    assert start.planner is None
    assert push._stands(trial, robot, start, 50.0)
    assert not push._stands(trial, robot, start, 150.0), "it can fall here"


def test_the_push_is_in_the_direction_that_was_asked_for(robot: RobotConfig) -> None:
    x, y, _ = point(angle_deg=180).scenario(robot, 40.0).push[0].force
    assert (x, y) == pytest.approx((-40.0, 0.0), abs=1e-9)
    assert point(mode="led").scenario(robot, 40.0).kill == ()


@pytest.fixture(scope="module")
def pushes(robot: RobotConfig) -> PushRange:
    return PushRange(robot, 1.0)


@pytest.mark.parametrize("angle_deg", [0, 45, 90, 180, -90])
def test_the_limit_is_that_of_the_push_study_in_the_stand(
    robot: RobotConfig, pushes: PushRange, angle_deg: int
) -> None:
    borne = limits_of(point(pose="stand", angle_deg=angle_deg, mode="led"), robot).body.force_n
    assert pushes.limit_n(math.radians(angle_deg)) == pytest.approx(borne, rel=0.02)


def test_a_push_is_its_share_of_the_limit_in_its_direction(pushes: PushRange) -> None:
    push = pushes.push(1.0, 0.3, 0.5, math.pi / 2)
    assert push.force == pytest.approx((0.0, 0.5 * pushes.limit_n(math.pi / 2), 0.0), abs=1e-3)
    assert (push.at, push.duration) == (1.0, 0.3)


def test_what_is_drawn_reaches_the_limit_in_every_direction(pushes: PushRange) -> None:
    dice, reached = random.Random(1), {-2: 0.0, -1: 0.0, 0: 0.0, 1: 0.0}
    for _ in range(300):
        x, y, _ = pushes.draw(dice, (0.3, 1.0), 1.0, 0.3).force
        angle = math.atan2(y, x)
        share = math.hypot(x, y) / pushes.limit_n(angle)
        assert 0.299 <= share <= 1.001
        quarter = math.floor(2.0 * angle / math.pi)
        reached[quarter] = max(reached[quarter], share)
    assert min(reached.values()) > 0.95
