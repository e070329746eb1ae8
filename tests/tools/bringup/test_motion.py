"""Plans, limits and the verdict on a jog."""

from __future__ import annotations

import math
import re

import msgspec
import numpy as np
import pytest

from services.joint.differential import joint_torque
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tests.tools.bringup.bench_drive import MODULE, PLAN, START, BenchDrive, jog_by
from tools.bringup.hanging_leg import HangingJoint
from tools.bringup.identify import plan_for
from tools.bringup.motion import (
    AnyPlan,
    Sample,
    limit_drives,
    why_out_of_reach,
    within_stops,
)
from tools.verbs.drive.jog import JogCheck, judge, what_to_see

LED = plan_for(1, 15.0, 0.0, HangingJoint(9.4, 88.0, (0.0, -0.3)))


@pytest.mark.parametrize("plan", [PLAN, LED], ids=["a jog", "sines about a bias"])
def test_the_reference_is_smooth_stays_in_its_reach_and_ends_where_it_began(
    plan: AnyPlan,
) -> None:
    t = np.linspace(0.0, plan.duration_s, 60001)
    q, v = np.array([[pair[1] for pair in plan.offset(float(one))] for one in t]).T
    assert (q[0], q[-1]) == pytest.approx((0.0, 0.0), abs=1e-12)
    low, high = plan.reach[1]
    assert low - 1e-9 <= q.min()
    assert max(q.max(), 0.0) <= max(high, 0.0) + 1e-9
    assert np.abs(v).max() <= 1.2 * plan.course.rate_max + 0.3
    np.testing.assert_allclose(np.gradient(q, t), v, atol=2e-3)


@pytest.mark.parametrize("course", [PLAN.course, LED.course])
def test_a_course_goes_as_far_as_its_span_says_and_no_farther(course: object) -> None:
    plan = PLAN._replace(course=course)  # type: ignore[arg-type]
    t = np.linspace(0.0, plan.course.duration_s, 60001)
    q = np.array([plan.course.at(float(one))[0] for one in t])
    low, high = plan.course.span
    assert low - 1e-9 <= q.min()
    assert q.max() == pytest.approx(high, rel=0.02)


def test_the_drive_itself_is_limited_to_the_torque_asked_for(robot: RobotConfig) -> None:
    limited = limit_drives(robot, PLAN)
    motor = limited.drive.current_lim * limited.drive.torque_constant
    phi, theta = joint_torque((motor, motor), robot.joint.gear_ratio)
    assert abs(phi) + abs(theta) == pytest.approx(PLAN.torque_limit)
    assert limited.drive.vel_limit <= robot.drive.vel_limit
    for wrong in (0.5, robot.joint.tau_module_max + 1.0, math.nan):
        with pytest.raises(DriveError, match="--torque-limit"):
            limit_drives(robot, PLAN._replace(torque_limit=wrong))


def test_limits_at_the_stops_are_wider_than_the_soft_ones(robot: RobotConfig) -> None:
    wide = within_stops(robot)
    assert wide.limits.knee.theta[1] > robot.limits.knee.theta[1]
    assert msgspec.structs.replace(wide, limits=robot.limits) == robot


@pytest.mark.parametrize(
    ("q", "words"),
    [
        (START, "^$"),
        ((0.0, -0.21), r"would go to -0\.160.*change the sign of --by"),
        ((0.0, -0.1), "outside.*xrl drive zero"),
        ((0.61, -1.0), "phi is at 0.610 rad, outside"),
        ((math.nan, -1.0), "outside"),
    ],
)
def test_a_joint_that_would_leave_its_limits_is_refused(
    robot: RobotConfig, q: Pair, words: str
) -> None:
    assert re.search(words, why_out_of_reach(robot, MODULE, PLAN, q))


@pytest.fixture
def drive(robot: RobotConfig) -> BenchDrive:
    return BenchDrive(limit_drives(robot, PLAN))


def verdict(samples: list[Sample]) -> dict[str, JogCheck]:
    return {row.what: row for row in judge(samples, PLAN)}


def jogged(drive: BenchDrive, robot: RobotConfig, by: float = 0.05) -> list[Sample]:
    return drive.run(limit_drives(robot, PLAN), jog_by(by)).samples


def test_friction_is_what_both_ways_take_more_than_gravity(
    drive: BenchDrive, robot: RobotConfig
) -> None:
    drive.friction, drive.load = 2.5, (0.0, -4.0)
    rows = verdict(jogged(drive, robot))
    assert float(rows["friction, dry and viscous"].value.split()[0]) == pytest.approx(2.5, rel=0.1)
    assert float(rows["torque at rest"].value.split()[0]) == pytest.approx(4.0, abs=2.5)


def test_a_joint_that_moves_too_little_did_not_follow(
    drive: BenchDrive, robot: RobotConfig
) -> None:
    drive.friction = 9.5  # below the limit, so nothing stops it, but hardly anything moves
    assert not verdict(jogged(drive, robot, 0.01))["theta travel"].good


def test_a_load_that_drags_the_sibling_along_is_seen(drive: BenchDrive, robot: RobotConfig) -> None:
    dragged = [
        s._replace(q=(s.q[0] + (0.03 if s.t_s > 1.0 else 0.0), s.q[1]))
        for s in jogged(drive, robot)
    ]
    rows = verdict(dragged)
    assert not rows["phi moved"].good
    assert rows["theta travel"].good


def turned(axis: int, angle: float) -> np.ndarray:
    """Return the rotation of the upper part against the lower, Rx(phi) or Ry(theta)."""
    c, s = math.cos(angle), math.sin(angle)
    if axis == 0:
        return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


@pytest.mark.parametrize("by", [0.1, -0.1])
@pytest.mark.parametrize("axis", [0, 1])
def test_what_a_person_is_asked_to_see_is_what_the_frames_do(axis: int, by: float) -> None:
    """x forward, y left, z up; below a torso that hangs still the lower part turns back."""
    upper, lower = turned(axis, by), turned(axis, by).T
    leans, swings = upper @ [0.0, 0.0, 1.0], lower @ [0.0, 0.0, -1.0]
    component, names = (1, ("right", "left")) if axis == 0 else (0, ("back", "forward"))
    for module in ("knee_left", "hip_right"):
        first, second = what_to_see(module, axis, by).split(";")
        assert names[int(leans[component] > 0.0)] in first
        assert names[int(swings[component] > 0.0)] in second
    told = what_to_see("ankle_left", axis, by)
    if axis == 1:
        assert ("toes point up" in told) == ((lower @ [1.0, 0.0, 0.0])[2] > 0.0)
    else:
        assert ("right edge up" in told) == ((lower @ [0.0, -1.0, 0.0])[2] > 0.0)
