"""How much of tau_coupled a module uses, and what takes its place (design section 4)."""

from __future__ import annotations

import pytest

from shared.config import RobotConfig
from tests.joint.helpers import Bench, command


def test_the_share_of_tau_coupled_is_let_go_of_quickly_and_taken_back_slowly(
    robot: RobotConfig,
) -> None:
    """One message can change it from all to none; a torque step that is not."""
    bench = Bench(robot)
    bench.to_track(tau_coupled=(10.0, -40.0))
    service, whole = robot.joint_service, bench.controller.tau
    for share, over_ms in ((0.0, service.coupled_ramp_ms), (1.0, service.blend_ms)):
        before, last = bench.controller.tau, bench.controller.tau
        cycles = round(over_ms * service.rate_hz / 1e3)
        for _ in range(cycles):
            tau = bench.cycle(bench.fresh(tau_coupled=(10.0, -40.0), coupled_share=share)).tau
            assert max(abs(a - b) for a, b in zip(tau, last, strict=True)) <= 40.5 / cycles
            last = tau
        assert abs(last[1] - before[1]) > 30.0
    assert last == pytest.approx(whole, abs=1e-6)


def test_what_tau_coupled_does_not_hold_the_gains_of_hold_do(robot: RobotConfig) -> None:
    bench = Bench(robot)
    bench.to_track()
    bench.run(200, fresh=True, coupled_share=0.25)
    k_p, k_d = robot.hold_gains("knee_right")
    setpoint, sent = bench.controller.setpoint, command()
    for axis in (0, 1):
        assert setpoint.k_p[axis] == pytest.approx(
            sent.k_p[axis] + 0.75 * max(0.0, k_p[axis] - sent.k_p[axis])
        )
        assert setpoint.k_d[axis] == pytest.approx(
            sent.k_d[axis] + 0.75 * max(0.0, k_d[axis] - sent.k_d[axis])
        )
