"""What must never happen after a fault or an emergency stop (design section 4)."""

from __future__ import annotations

import numpy as np
import pytest

from services.joint.drivers.base import DriveStatus
from shared.clock import NS_PER_S
from shared.config import RobotConfig
from shared.messages import Cause, Mode
from tests.joint.helpers import Bench


@pytest.fixture
def bench(robot: RobotConfig) -> Bench:
    return Bench(robot)


@pytest.mark.parametrize("status", [DriveStatus.LOST, DriveStatus.IDLE, DriveStatus.ERROR])
@pytest.mark.parametrize("before", [Mode.HOLD, Mode.TRACK, Mode.DAMP])
def test_torque_is_zero_after_drive_fault_whatever_comes(
    bench: Bench, before: Mode, status: DriveStatus
) -> None:
    bench.to(before)
    bench.status = status
    result = bench.cycle(bench.fresh())
    assert result.tau == (0.0, 0.0)
    assert result.event is not None
    assert result.event.mode_after == Mode.FAULT
    bench.status, bench.q, bench.v = DriveStatus.ARMED, (0.5, -0.1), (1.0, 1.0)
    for _ in range(100):
        assert bench.cycle(bench.fresh(), estop=True) == ((0.0, 0.0), None)
        assert bench.cycle(bench.fresh()) == ((0.0, 0.0), None)


@pytest.mark.parametrize("before", [Mode.DISARMED, Mode.HOLD, Mode.TRACK])
def test_emergency_stop_leads_from_any_mode_to_damp(bench: Bench, before: Mode) -> None:
    bench.to(before)
    event = bench.cycle(estop=True).event
    assert event is not None
    assert (event.mode_before, event.mode_after) == (before, Mode.DAMP)
    assert event.cause == Cause.ESTOP


@pytest.mark.parametrize("before", [Mode.HOLD, Mode.TRACK])
def test_damp_has_no_stiffness_at_all(bench: Bench, before: Mode) -> None:
    bench.to(before)
    bench.cycle(estop=True)
    bench.run(20)
    here = bench.cycle().tau
    bench.q = (bench.q[0] + 0.2, bench.q[1] - 0.2)
    np.testing.assert_allclose(bench.cycle().tau, here, atol=0.05)


def test_damp_fades_the_feedforward_to_zero_in_its_time(robot: RobotConfig, bench: Bench) -> None:
    bench.to_track(tau_ff=(3.0, -25.0))
    bench.cycle(estop=True)
    cycles = round(robot.joint_service.damp_fade_s * robot.joint_service.rate_hz)
    taus = np.abs([result.tau for result in bench.run(cycles)])
    assert np.all(np.diff(taus, axis=0) <= 0.0)
    assert taus[-2].max() > 0.0
    assert bench.controller.tau == (0.0, 0.0)


def test_torque_in_damp_never_exceeds_what_is_left_of_the_feedforward(
    robot: RobotConfig, bench: Bench
) -> None:
    bench.to_track(tau_ff=(3.0, -25.0), tau_coupled=(12.0, -9.0))
    bench.cycle(estop=True)
    entered_ns, fade_ns = bench.now_ns, robot.joint_service.damp_fade_s * NS_PER_S
    for cycle in range(2400):
        tau = bench.cycle(bench.fresh()).tau  # a planner that has not heard changes nothing
        left = 1.0 - (bench.now_ns - entered_ns) / fade_ns
        if cycle:
            np.testing.assert_allclose(tau, np.multiply((3.0, -25.0), left), atol=1e-9)
    assert left > 0.0


def test_damp_resists_motion(robot: RobotConfig, bench: Bench) -> None:
    bench.to_hold()
    bench.cycle(estop=True)
    bench.v = (0.5, -0.3)
    k_d = robot.joint_service.damp_k_d
    assert bench.run(10)[-1].tau == pytest.approx((-k_d * 0.5, k_d * 0.3))


def test_emergency_stop_never_drops_the_load_that_the_springs_carried(bench: Bench) -> None:
    """A slow sink, never a drop: a stand without a planner has no feedforward to fade."""
    bench.to_hold()
    bench.q = (0.02, -1.02)
    bench.run(5)
    carried = bench.controller.tau[1]
    assert carried == pytest.approx(1500.0 * 0.02)
    bench.cycle(estop=True)
    bench.run(5)
    assert bench.controller.tau[1] > 0.9 * carried
