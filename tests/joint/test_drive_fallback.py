"""What a drive does that is left alone: its service has died, or its cable is out."""

from __future__ import annotations

import math

import msgspec
import pytest

from services.joint.drive_manager import IDLE_EVERY_NS, DriveCommand
from services.joint.drivers.base import DriveStatus
from shared.bus.messages import Mode, Pair
from shared.config.robot_config import RobotConfig
from tests.joint.helpers import command
from tests.joint.test_drive_manager import Bench


def joint_gains(bench: Bench) -> Pair:
    """Return the stiffness, N m/rad, and the damping, N m s/rad, of each axis, by its drive."""
    assert bench.target is not None
    scale = (2.0 * bench.robot.joint.gear_ratio) ** 2 / (4.0 * math.pi)
    (pos_gain, _), (vel_gain, _) = bench.target.pos_gain, bench.target.vel_gain
    return scale * pos_gain * vel_gain, scale * vel_gain


SOFT_P: Pair = (120.0, 300.0)
SOFT_D: Pair = (4.0, 10.0)


def soft_in_track(robot: RobotConfig, module: str) -> Bench:
    """Bring a module to TRACK on gains far below HOLD's, off its reference and moving."""
    bench = Bench(robot, "onboard", module)
    bench.q = (0.02, -1.0) if module.startswith("knee") else (0.02, 0.1)
    while bench.mode is not Mode.HOLD:
        bench.cycle()
    q_ref = (bench.q[0] + 0.02, bench.q[1] - 0.03)
    for _ in range(800):
        bench.seq += 1
        sent = command(seq=bench.seq, echo_t_ns=bench.now_ns, q_ref=q_ref, k_p=SOFT_P, k_d=SOFT_D)
        bench.cycle(sent)
    assert bench.mode is Mode.TRACK
    bench.v = (0.1, -0.2)
    bench.cycle(msgspec.structs.replace(sent, seq=bench.seq + 1, echo_t_ns=bench.now_ns))
    return bench


@pytest.mark.parametrize("module", ["ankle_right", "ankle_left", "knee_right", "hip_left"])
def test_a_drive_is_left_with_holds_gains_at_an_ankle_and_with_the_laws_own_elsewhere(
    robot: RobotConfig, module: str
) -> None:
    """With 4 N m s/rad on each ankle 7 of 26 pairs of pushes fell, all six services dead."""
    bench = soft_in_track(robot, module)
    k_p, k_d = SOFT_P, SOFT_D
    if module.startswith("ankle"):
        k_p, k_d = robot.hold_gains(module)
        assert min(k_p) > max(SOFT_P)
        assert min(k_d) > max(SOFT_D)
    left = joint_gains(bench)
    assert left == pytest.approx((sum(k_p) / 2.0, sum(k_d) / 2.0), rel=0.03)


@pytest.mark.parametrize("module", ["ankle_right", "knee_right", "hip_left"])
def test_what_the_drive_is_left_with_changes_nothing_while_the_service_lives(
    robot: RobotConfig, module: str
) -> None:
    """At the sample: TRACK's law is the command's, to the last of its torque."""
    bench = soft_in_track(robot, module)
    q_ref = (bench.q[0] + 0.02, bench.q[1] - 0.03)
    law = [
        SOFT_P[i] * (q_ref[i] - bench.q[i]) + SOFT_D[i] * (0.0 - bench.v[i]) + ff
        for i, ff in enumerate((3.0, -25.0))
    ]
    assert bench.carried() == pytest.approx(law, abs=1e-9)


@pytest.mark.parametrize("module", ["ankle_right", "knee_right"])
def test_a_drive_left_in_damp_goes_on_with_damps_own_gains(robot: RobotConfig, module: str) -> None:
    """A drive that is left sinks: with HOLD's gains it would be the one that does not."""
    bench = soft_in_track(robot, module)
    bench.cycle(estop=True)
    for _ in range(1000):
        bench.cycle()
    assert bench.mode is Mode.DAMP
    own = bench.module.controller.setpoint
    wanted = (sum(own.k_p) / 2.0, sum(own.k_d) / 2.0)
    assert joint_gains(bench) == pytest.approx(wanted, rel=0.03)


BACK = [DriveStatus.ERROR, DriveStatus.IDLE, DriveStatus.UNZEROED]


@pytest.mark.parametrize("back", BACK)
def test_both_axes_of_a_drive_that_was_lost_go_idle_if_it_comes_back_with_one_disarmed(
    robot: RobotConfig, back: DriveStatus
) -> None:
    """Its sibling went on pulling alone: on theta by what it pulled on phi."""
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    bench.status = DriveStatus.LOST
    orders = [bench.cycle().command for _ in range(200)]
    assert bench.mode is Mode.FAULT
    assert set(orders) == {DriveCommand.NOTHING}, "it may hold still"
    bench.status = back
    assert bench.cycle().command is DriveCommand.IDLE
    again = [bench.cycle().command for _ in range(3 * IDLE_EVERY_NS // bench.cycle_ns)]
    assert again.count(DriveCommand.IDLE) == 3, "the frame may have been lost"
    assert bench.mode is Mode.FAULT


@pytest.mark.parametrize("back", [DriveStatus.ARMED, DriveStatus.HOLDING])
def test_a_drive_that_was_lost_and_comes_back_holding_is_left_alone(
    robot: RobotConfig, back: DriveStatus
) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    for status in (DriveStatus.LOST, back):
        bench.status = status
        orders = [bench.cycle().command for _ in range(2000)]
        assert set(orders) == {DriveCommand.NOTHING}
    assert bench.mode is Mode.FAULT
    assert bench.module.leaves_holding, "nor does ending its service idle it"
