"""The control law between steps: the firmware's 8 kHz loop on a joint is the reference."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.drives.axis_bank import AxisBank
from shared.can.cansimple import AxisState, ControlMode, InputMode
from tests.simulator.banks import DRIVE, ZERO, make_bank

GEAR = 17.5
INERTIA = 0.15 / (2.0 * GEAR**2)
"""kg m^2 that each of a joint's two motors carries: the joint's armature."""
FINE = 16_000
"""Hz of the physics here; divisible by every rate tried."""
STEP = 0.1
"""turn"""


def motor_gains(k_p: float, k_d: float) -> tuple[float, float]:
    """Return pos_gain and vel_gain of a motor that has its half of a joint's k_p and k_d."""
    return k_p / k_d, k_d / (2.0 * GEAR**2) * 2.0 * math.pi


def scalar_firmware(pos_gain: float, vel_gain: float, seconds: float) -> list[float]:
    """Return positions at 1 kHz: encoder PLL and law written out, one number at a time, 8 kHz."""
    h = 1.0 / 8000.0
    pos = vel = pos_hat = vel_hat = torque = 0.0
    track = []
    for k in range(round(seconds * FINE)):
        if k % (FINE // 8000) == 0:
            pos_hat += h * vel_hat
            error = pos - pos_hat
            pos_hat += h * 2000.0 * error
            vel_hat += h * 1e6 * error
            torque = vel_gain * (pos_gain * (STEP - pos_hat) - vel_hat)
        vel += torque / (INERTIA * 2.0 * math.pi) / FINE
        pos += vel / FINE
        if k % (FINE // 1000) == 0:
            track.append(pos)
    return track


def emulated(pos_gain: float, vel_gain: float, seconds: float, rate: int) -> list[float]:
    """Return the same of the bank, stepped at a rate, its torque held between."""
    bank = AxisBank(DRIVE, encoder_counts_per_turn=1 << 22, watchdog=False)
    bank.step(0.0, ZERO, ZERO)
    bank.set_modes(0, ControlMode.POSITION, InputMode.PASSTHROUGH)
    bank.request_state(0, AxisState.CLOSED_LOOP_CONTROL)
    bank.pos_gain[0], bank.vel_gain[0] = pos_gain, vel_gain
    bank.input_pos[0] = STEP
    pos, vel = np.zeros(12), np.zeros(12)
    torque = bank.step(0.0, pos, vel).copy()
    track = []
    for k in range(round(seconds * FINE)):
        if k and k % (FINE // rate) == 0:
            torque = bank.step(k / FINE, pos, vel).copy()
        vel[0] += torque[0] / (INERTIA * 2.0 * math.pi) / FINE
        pos[0] += vel[0] / FINE
        if k % (FINE // 1000) == 0:
            track.append(float(pos[0]))
    return track


@pytest.mark.parametrize(("k_p", "k_d"), [(900.0, 30.0), (1500.0, 60.0), (2000.0, 100.0)])
def test_stepped_with_the_world_a_stiff_joint_moves_as_under_the_firmwares_own_rate(
    k_p: float, k_d: float
) -> None:
    gains = motor_gains(k_p, k_d)
    reference = np.array(scalar_firmware(*gains, 0.3))
    worst = {
        rate: float(np.abs(np.array(emulated(*gains, 0.3, rate)) - reference).max()) / STEP
        for rate in (1000, 500)
    }
    assert worst[1000] < 0.03
    assert worst[500] > 1.5 * worst[1000], "so the drives must step with the world"


def test_a_bank_wants_every_step_of_the_world_only_while_an_armed_axis_has_its_own_loop() -> None:
    bank = make_bank()
    assert not bank.regulates
    bank.set_modes(3, ControlMode.POSITION, InputMode.PASSTHROUGH)
    bank.step(0.001, ZERO, ZERO)
    assert bank.regulates
    bank.request_state(3, AxisState.IDLE)
    assert not bank.regulates


def test_torque_mode_empties_the_integrator() -> None:
    bank = make_bank(ControlMode.VELOCITY)
    bank.vel_integrator_gain[:] = 0.5
    bank.input_vel[:] = 1.0
    for k in range(1, 50):
        bank.step(k * 1e-3, ZERO, ZERO)
    bank.set_modes(0, ControlMode.TORQUE, InputMode.PASSTHROUGH)
    bank.step(0.05, ZERO, ZERO)
    bank.set_modes(0, ControlMode.VELOCITY, InputMode.PASSTHROUGH)
    torque = bank.step(0.051, ZERO, ZERO)
    assert torque[0] == pytest.approx(bank.vel_gain[0])
    assert torque[1] > torque[0] + 0.02


def test_axes_with_another_encoder_bandwidth_follow_by_their_own() -> None:
    both = make_bank()
    both.settings.set(0, "axis1.encoder.config.bandwidth", 200.0)
    slow = make_bank()
    slow.settings.fill("encoder.config.bandwidth", 200.0)
    speed = np.full(12, 5.0)
    for k in range(1, 10):
        both.step(k * 1e-3, speed * k * 1e-3, speed)
        slow.step(k * 1e-3, speed * k * 1e-3, speed)
    assert both.vel_estimate[1] == pytest.approx(slow.vel_estimate[1], abs=1e-9)
    assert both.vel_estimate[0] > both.vel_estimate[1] + 0.5


@pytest.mark.parametrize("mode", [ControlMode.TORQUE, ControlMode.VELOCITY, ControlMode.POSITION])
@pytest.mark.parametrize("column", ["input_pos", "input_vel", "input_torque"])
def test_what_is_no_number_is_not_made_one(mode: ControlMode, column: str) -> None:
    """The firmware's clamp passes NaN on; made the limit's torque, it would push a motor."""
    bank = make_bank()
    for axis in (0, 1):
        bank.set_modes(axis, mode, InputMode.PASSTHROUGH)
        bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)
    bank.pos_gain[:], bank.vel_gain[:] = 20.0, 0.2
    getattr(bank, column)[0] = math.nan
    torque = bank.step(bank.now_s + 1e-3, ZERO, ZERO)
    used = {"input_torque": 1, "input_vel": 2, "input_pos": 3}[column] <= mode
    assert math.isnan(torque[0]) == used
    assert math.isfinite(torque[1])
