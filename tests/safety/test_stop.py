"""What must never happen after a fault or an emergency stop (docs/architecture.md#age-rule)."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from services.joint.controller import CycleResult
from shared.bus.messages import Cause, DriveStatus, Mode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import kind_of
from tests.joint.helpers import Bench
from tests.robots import ROBOT

POSES = {"ankle": (0.02, 0.14), "knee": (0.02, -1.0), "hip": (0.02, 0.9)}
"""Inside the limits."""
FADED = 3000
"""Cycles after which a load has faded."""


@pytest.fixture
def bench() -> Bench:
    return Bench(ROBOT)


def stopped(module: str, mode: Mode = Mode.HOLD, cycles: int = FADED) -> Bench:
    """Return a bench that was stopped in a mode, some cycles later."""
    bench = Bench(ROBOT, module)
    bench.q = POSES[kind_of(module)]
    bench.to(mode)
    bench.cycle(estop=True)
    bench.run(cycles)
    return bench


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
        assert bench.cycle(bench.fresh(), estop=True) == CycleResult((0.0, 0.0), None)
        assert bench.cycle(bench.fresh()) == CycleResult((0.0, 0.0), None)


@pytest.mark.parametrize("before", [Mode.HOLD, Mode.TRACK])
@pytest.mark.parametrize("module", ["knee_right", "hip_left"])
def test_what_sinks_has_no_stiffness(before: Mode, module: str) -> None:
    bench = stopped(module, before, cycles=20)
    here = bench.cycle().tau
    bench.q = (bench.q[0], bench.q[1] - 0.2)
    np.testing.assert_allclose(bench.cycle().tau, here, atol=0.05)


@pytest.mark.parametrize(
    ("module", "axis"), [("ankle_left", 0), ("ankle_left", 1), ("knee_right", 0), ("hip_right", 0)]
)
def test_ankles_and_frontal_axes_hold_in_damp(module: str, axis: int) -> None:
    """With every stiffness off, an inverted pendulum is left: it toppled."""
    bench = stopped(module)
    moved = [bench.q[0], bench.q[1]]
    moved[axis] += 0.01
    bench.q = (moved[0], moved[1])
    stand = ROBOT.stand_gains(module).k_p[axis]
    assert bench.run(5)[-1].tau[axis] == pytest.approx(-0.01 * stand)


def test_torque_in_damp_is_the_feedforward_left_until_what_sinks_has_none(bench: Bench) -> None:
    bench.to_track(tau_ff=(3.0, -25.0), tau_coupled=(12.0, -9.0))
    bench.cycle(estop=True)
    entered_ns, service = bench.now_ns, ROBOT.joint_service
    for cycle in range(round(service.damp_fade_s * service.rate_hz) + 100):
        tau = bench.cycle(bench.fresh()).tau  # a planner that has not heard changes nothing
        since_ns = bench.now_ns - entered_ns
        left = max(0.0, 1.0 - since_ns / (service.damp_fade_s * NS_PER_S))
        coupled = max(0.0, 1.0 - since_ns / (service.coupled_ramp_ms * NS_PER_MS))
        if cycle:
            expected = (3.0 + 12.0 * coupled, -25.0 * left - 9.0 * coupled)
            np.testing.assert_allclose(tau, expected, atol=1e-9)
    assert (left, tau[1]) == (0.0, 0.0)


def test_a_stop_never_drops_what_springs_carried_and_damps(bench: Bench) -> None:
    """A slow sink, never a drop: a stand without a planner has no feedforward to fade."""
    bench.to_hold()
    bench.q = (0.02, -1.02)
    bench.run(5)
    carried = bench.controller.tau[1]
    assert carried == pytest.approx(ROBOT.stand_gains("knee_right").k_p[1] * 0.02)
    bench.cycle(estop=True)
    assert bench.run(5)[-1].tau[1] > 0.9 * carried
    still = bench.run(FADED)[-1].tau[1]
    bench.v = (0.0, -0.3)
    resists = bench.run(round(ROBOT.joint_service.blend_ms / 2) + 10)[-1].tau[1] - still
    assert resists == pytest.approx(ROBOT.joint_service.damp_k_d * 0.3)


@pytest.mark.parametrize("stopped_first", [False, True])
def test_after_a_fall_every_axis_only_damps_and_none_is_jerked(
    bench: Bench, stopped_first: bool
) -> None:
    bench.to_track(tau_ff=(3.0, -25.0), tau_coupled=(12.0, -9.0))
    if stopped_first:
        bench.cycle(estop=True)
    before = bench.run(5)[-1].tau
    taus = [bench.cycle(bench.fresh(hold=True, fallen=True)).tau for _ in range(60)]
    assert (bench.mode, bench.controller.cause) == (Mode.DAMP, Cause.FALLEN)
    for last, tau in itertools.pairwise([before, *taus]):
        assert tau == pytest.approx(last, abs=6.0)
    assert taus[-1] == (0.0, 0.0)
    bench.v = (0.1, -0.3)
    k_d = ROBOT.joint_service.fallen_k_d
    damped = bench.run(40)[-1].tau
    assert damped == pytest.approx((-0.1 * k_d, 0.3 * k_d), rel=0.02)


@pytest.mark.parametrize("module", ["ankle_left", "knee_left", "hip_right"])
def test_in_damp_the_rest_comes_to_the_stand_gains(module: str) -> None:
    bench = Bench(ROBOT, module)
    soft = {"k_p": (100.0, 90.0), "k_d": (5.0, 4.0), "tau_ff": (3.0, -5.0)}
    bench.to_track(**soft)
    bench.cycle(estop=True)
    bench.run(FADED)
    setpoint, stand = bench.controller.law.current, ROBOT.stand_gains(module)
    sinks = kind_of(module) in ROBOT.joint_service.damp_sinks
    for axis in (0,) if sinks else (0, 1):
        assert setpoint.k_p[axis] == pytest.approx(max(stand.k_p[axis], soft["k_p"][axis]))
        assert setpoint.k_d[axis] == pytest.approx(max(stand.k_d[axis], soft["k_d"][axis]))


@pytest.mark.parametrize("carried", [(200.0, 0.0), (-90.0, 90.0), (1e4, -1e4)])
def test_what_a_drive_carried_in_a_gap_goes_on_within_the_motors_limits(
    bench: Bench, carried: tuple[float, float]
) -> None:
    bench.to_hold()
    phi, theta = bench.law.resume(bench.controller, bench.now_ns, carried)
    most = ROBOT.joint.tau_module_max + 1e-9
    assert abs(phi + theta) <= most
    assert abs(theta - phi) <= most
    assert np.sign(theta) == np.sign(carried[1]) or carried[1] == 0.0


def test_a_knee_is_caught_and_damped_before_it_topples() -> None:
    stand, sunk = ROBOT.stand_gains("knee_left"), stopped("knee_left")
    sunk.move((sunk.q[0], ROBOT.joint_service.damp_knee_stop - 0.02))
    still = sunk.run(5)[-1].tau[1]
    assert still == pytest.approx(0.02 * stand.k_p[1])
    sunk.v = (0.0, -0.1)
    moving = sunk.run(200)[-1].tau[1]
    assert moving - still == pytest.approx(0.1 * stand.k_d[1], rel=0.05)


def test_a_knee_that_is_lower_than_the_stop_is_caught_where_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not pushed up to the stop: the robot would rise by itself after an emergency stop."""
    low = ROBOT.joint_service.damp_knee_stop - 0.1
    monkeypatch.setitem(POSES, "knee", (0.02, low))
    bench = stopped("knee_left")
    assert bench.cycle().tau[1] == pytest.approx(0.0, abs=1e-6)
    bench.move((0.02, low - 0.01))
    caught = bench.run(5)[-1].tau[1]
    assert caught == pytest.approx(0.01 * ROBOT.stand_gains("knee_left").k_p[1], rel=1e-3)
