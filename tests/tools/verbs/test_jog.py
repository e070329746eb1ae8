"""`xrl drive jog`: on a bench drive in virtual time, and the verb on the emulated robot."""

from __future__ import annotations

import math
import os
import re
import signal

import numpy as np
import pytest

from services.joint.differential import (
    joint_torque,
)
from services.joint.drivers.base import DriveReading, DriveStatus
from shared.bus.messages import Pair
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tests.tools.verbs.bench_drive import START, BenchDrive
from tools.bringup import jog_drive
from tools.bringup.jogging import (
    APART_MAX,
    JogPlan,
    Sample,
    gentle,
    judge,
    outside,
    what_to_see,
)

MODULE = "knee_left"
PLAN = JogPlan(axis=1, by=0.05, period_s=2.0, cycles=2, torque_limit=10.0)


@pytest.fixture
def limited(robot: RobotConfig) -> RobotConfig:
    return gentle(robot, PLAN)


@pytest.fixture
def drive(limited: RobotConfig) -> BenchDrive:
    return BenchDrive(limited)


def jog(
    drive: BenchDrive,
    robot: RobotConfig,
    plan: JogPlan = PLAN,
    *,
    q_seen: Pair = START,
    interrupts: jog_drive.Interrupts | None = None,
    published: list[Sample] | None = None,
) -> jog_drive.JogResult:
    def progress(sample: Sample) -> None:
        if published is not None:
            published.append(sample)

    return jog_drive.jog_drive(
        drive,
        robot,
        MODULE,
        plan,
        q_seen=q_seen,
        interrupts=interrupts or jog_drive.Interrupts(),
        progress=progress,
        clock=drive.clock,
    )


@pytest.mark.parametrize("plan", [PLAN, PLAN._replace(axis=0, by=-0.08, cycles=1)])
def test_a_free_joint_follows_and_comes_back_and_is_idle(
    drive: BenchDrive, limited: RobotConfig, plan: JogPlan
) -> None:
    published: list[Sample] = []
    outcome = jog(drive, limited, plan, published=published)
    assert outcome.trouble == ""
    assert all(row.good for row in judge(outcome.samples, plan))
    assert drive.q == pytest.approx(START, abs=0.01)
    assert outcome.is_idle
    assert drive.status is DriveStatus.IDLE
    assert drive.largest <= PLAN.torque_limit + 1e-9
    assert len(published) > 8


def test_friction_is_what_both_ways_take_more_than_gravity(
    drive: BenchDrive, limited: RobotConfig
) -> None:
    drive.friction, drive.load = 2.5, (0.0, -4.0)
    outcome = jog(drive, limited)
    rows = {row.what: row for row in judge(outcome.samples, PLAN)}
    assert float(rows["friction, dry and viscous"].value.split()[0]) == pytest.approx(2.5, rel=0.1)
    assert float(rows["torque at rest"].value.split()[0]) == pytest.approx(4.0, abs=2.5)


def test_a_jammed_joint_is_given_up_at_the_torque_limit(
    drive: BenchDrive, limited: RobotConfig
) -> None:
    drive.jammed = True
    outcome = jog(drive, limited, PLAN._replace(by=0.12))
    assert "torque limit of 10 N m" in outcome.trouble
    assert drive.largest == pytest.approx(PLAN.torque_limit, abs=0.01)
    assert outcome.is_idle


def test_a_joint_that_moves_too_little_did_not_follow(
    drive: BenchDrive, limited: RobotConfig
) -> None:
    drive.friction = 9.5  # below the limit, so nothing stops it, but hardly anything moves
    rows = {
        row.what: row for row in judge(jog(drive, limited, PLAN._replace(by=0.01)).samples, PLAN)
    }
    assert not rows["theta went"].good


def test_motors_that_push_the_wrong_way_stop_within_the_torque_limit(
    drive: BenchDrive, limited: RobotConfig
) -> None:
    drive.reversed = True
    outcome = jog(drive, limited)
    assert "apart" in outcome.trouble or "torque limit" in outcome.trouble
    assert drive.largest <= PLAN.torque_limit + 1e-9
    assert (
        max(abs(a - b) for a, b in zip(outcome.samples[-1].q, START, strict=True)) < 1.5 * APART_MAX
    )
    assert drive.status is DriveStatus.IDLE


def test_a_load_that_drags_the_sibling_along_is_seen(
    drive: BenchDrive, limited: RobotConfig
) -> None:
    samples = [
        Sample(s.t_s, s.q_ref, (s.q[0] + (0.03 if s.t_s > 1.0 else 0.0), s.q[1]), s.tau)
        for s in jog(drive, limited).samples
    ]
    rows = {row.what: row for row in judge(samples, PLAN)}
    assert not rows["phi strayed"].good
    assert rows["theta went"].good


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"fails_at_s": 1.2}, "the drive is ERROR"),
        ({"never_arms": True}, "does not arm: IDLE"),
        ({"silent_at_s": 1.2}, "no sample of the drive"),
    ],
)
def test_a_drive_that_fails_stops_it(
    drive: BenchDrive, limited: RobotConfig, fault: dict[str, float], words: str
) -> None:
    for name, value in fault.items():
        setattr(drive, name, value)
    outcome = jog(drive, limited)
    assert words in outcome.trouble
    assert drive.idles >= 3
    assert outcome.is_idle == ("silent_at_s" not in fault), "a silent drive proves nothing"


def test_a_drive_that_stays_armed_is_not_reported_idle(
    drive: BenchDrive, limited: RobotConfig
) -> None:
    drive.deaf = True
    assert not jog(drive, limited).is_idle


def test_an_interrupt_idles_the_drive_first(drive: BenchDrive, limited: RobotConfig) -> None:
    interrupts = jog_drive.Interrupts()
    with interrupts.kept():
        drive_read = drive.read

        def read(timeout_s: float) -> DriveReading | None:
            if drive.now_ns > 2.5 * NS_PER_S and not interrupts.number:
                os.kill(os.getpid(), signal.SIGTERM)
            return drive_read(timeout_s)

        drive.read = read  # type: ignore[method-assign]
        outcome = jog(drive, limited, interrupts=interrupts)
    assert outcome.trouble == "stopped by SIGTERM"
    assert outcome.is_idle
    assert interrupts.number == signal.SIGTERM


def test_an_error_of_our_own_idles_the_drive_too(drive: BenchDrive, limited: RobotConfig) -> None:
    def broken(_sample: Sample) -> None:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        jog_drive.jog_drive(
            drive, limited, MODULE, PLAN, q_seen=START,
            interrupts=jog_drive.Interrupts(), progress=broken, clock=drive.clock,
        )  # fmt: skip
    assert drive.status is DriveStatus.IDLE


def test_a_joint_that_was_moved_after_the_question_is_not_jogged(
    drive: BenchDrive, limited: RobotConfig
) -> None:
    outcome = jog(drive, limited, q_seen=(START[0], START[1] + 0.06))
    assert "has moved by 0.060 rad" in outcome.trouble
    assert outcome.samples == []
    assert drive.largest == 0.0


def test_the_drive_itself_is_limited_to_the_torque_asked_for(robot: RobotConfig) -> None:
    limited = gentle(robot, PLAN)
    motor = limited.drive.current_lim * limited.drive.torque_constant
    phi, theta = joint_torque((motor, motor), robot.joint.gear_ratio)
    assert abs(phi) + abs(theta) == pytest.approx(PLAN.torque_limit)
    assert limited.drive.vel_limit <= robot.drive.vel_limit
    for wrong in (0.5, robot.joint.tau_module_max + 1.0, math.nan):
        with pytest.raises(DriveError, match="--torque-limit"):
            gentle(robot, PLAN._replace(torque_limit=wrong))


def test_the_reference_is_smooth_and_ends_where_it_began() -> None:
    times = np.linspace(0.0, PLAN.duration_s, 4000)
    q, v = np.array([[row[1] for row in PLAN.offset(float(t))] for t in times]).T
    assert (q[0], q[-1]) == (0.0, 0.0)
    assert q.max() == pytest.approx(PLAN.by, abs=1e-6)
    np.testing.assert_allclose(np.gradient(q, times), v, atol=2e-3)


@pytest.mark.parametrize(
    ("q", "plan", "words"),
    [
        ((0.0, -0.21), PLAN, r"would go to -0\.160.*--by with the other"),
        ((0.0, -0.1), PLAN, "outside.*xrl drive zero"),
        ((0.61, -1.0), PLAN, "phi is at 0.610 rad, outside"),
        ((math.nan, -1.0), PLAN, "outside"),
    ],
)
def test_a_joint_that_would_leave_its_limits_is_refused(
    robot: RobotConfig, q: Pair, plan: JogPlan, words: str
) -> None:
    assert re.search(words, outside(robot, MODULE, plan, q))
    assert outside(robot, MODULE, PLAN, START) == ""


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
    published = what_to_see("ankle_left", axis, by)
    if axis == 1:
        toes = lower @ [1.0, 0.0, 0.0]
        assert ("toes point up" in published) == (toes[2] > 0.0)
    else:
        right_edge = lower @ [0.0, -1.0, 0.0]
        assert ("right edge up" in published) == (right_edge[2] > 0.0)
