"""The emulated drives: the firmware's law, its limits and its traps."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.drives.axis_bank import AXIS_NAMES, FAULTS, AxisBank, AxisErrors
from shared.can.cansimple import AxisError, AxisState, ControllerError, ControlMode, InputMode
from shared.exceptions import DriveError
from tests.simulator.banks import CPR, DRIVE, DT, ZERO, make_bank


def lift_bus_limits(bank: AxisBank) -> None:
    """Let any power pass."""
    bank.settings.fill("config.dc_max_negative_current", -math.inf)
    bank.settings.fill("config.dc_bus_overvoltage_trip_level", math.inf)
    bank.settings.fill("config.dc_bus_undervoltage_trip_level", -math.inf)


def clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


def firmware_torque(
    bank: AxisBank, axis: int, mode: int, pos: float, vel: float, integrator: float = 0.0
) -> float:
    """Return the torque of one axis as controller.cpp computes it, one number at a time."""
    vel_limit, gain = float(bank.vel_limit[axis]), float(bank.vel_gain[axis])
    torque_lim = float(bank.current_lim[axis]) * DRIVE.torque_constant
    torque = clamp(float(bank.input_torque[axis]), torque_lim)
    if mode >= 2:
        vel_des = clamp(float(bank.input_vel[axis]), vel_limit)
        if mode == 3:
            vel_des += float(bank.pos_gain[axis]) * (float(bank.input_pos[axis]) - pos)
        torque += gain * (clamp(vel_des, vel_limit) - vel) + integrator
    else:
        torque = max((-vel_limit - vel) * gain, min((vel_limit - vel) * gain, torque))
    return clamp(torque, torque_lim)


number = st.floats(-50.0, 50.0)
gain = st.floats(0.0, 40.0)


@given(
    modes=st.lists(st.sampled_from([1, 2, 3]), min_size=12, max_size=12),
    inputs=st.lists(st.tuples(number, number, number), min_size=12, max_size=12),
    gains=st.lists(st.tuples(gain, gain), min_size=12, max_size=12),
    pos=st.lists(number, min_size=12, max_size=12),
    vel=st.lists(number, min_size=12, max_size=12),
)
def test_torque_equals_the_scalar_law_of_the_firmware(modes, inputs, gains, pos, vel) -> None:
    bank = AxisBank(DRIVE, encoder_counts_per_turn=CPR, watchdog=False)
    bank.settings.fill("controller.config.enable_torque_mode_vel_limit", value=True)
    lift_bus_limits(bank)
    bank.step(0.0, np.array(pos), np.array(vel))
    for axis in range(12):
        bank.set_modes(axis, modes[axis], InputMode.PASSTHROUGH)
        bank.request_state(axis, AxisState.CLOSED_LOOP_CONTROL)
        bank.input_pos[axis], bank.input_vel[axis], bank.input_torque[axis] = inputs[axis]
        bank.pos_gain[axis], bank.vel_gain[axis] = gains[axis]
    torque = bank.step(0.0, np.array(pos), np.array(vel))
    for axis in range(12):
        quantised = math.floor(pos[axis] * CPR) / CPR
        expected = firmware_torque(bank, axis, modes[axis], quantised, vel[axis])
        assert torque[axis] == pytest.approx(expected, abs=1e-9)


def test_integrator_adds_gain_times_velocity_error_over_time() -> None:
    bank = make_bank(ControlMode.VELOCITY)
    bank.vel_gain[:] = 0.1
    bank.vel_integrator_gain[:] = 0.5
    bank.input_vel[4] = 2.0
    torque = [float(bank.step(k * DT, ZERO, ZERO)[4]) for k in range(1, 101)]
    # The first step regulates with an empty integrator, the 100th with 99 steps in it.
    assert torque[0] == pytest.approx(0.2)
    assert torque[-1] == pytest.approx(0.2 + 0.5 * 2.0 * 99 * DT)


def test_integrator_decays_where_the_torque_is_limited() -> None:
    bank = make_bank(ControlMode.VELOCITY)
    bank.vel_integrator_gain[:] = 1.0 / 3.0
    bank.input_vel[0] = 10.0
    for k in range(1, 200):
        bank.step(k * DT, ZERO, ZERO)
    bank.input_torque[0] = 100.0
    for k in range(200, 400):
        bank.step(k * DT, ZERO, ZERO)
    bank.input_torque[0] = 0.0
    assert bank.step(0.4, ZERO, ZERO)[0] == pytest.approx(10.0 / 6.0, rel=1e-3)


def test_torque_is_clamped_to_current_lim_times_torque_constant() -> None:
    bank = make_bank()
    bank.vel_gain[:] = 10.0  # else the torque mode velocity limit clamps first
    bank.input_torque[:6] = 99.0
    bank.input_torque[6:] = -99.0
    torque = bank.step(DT, ZERO, ZERO)
    assert torque[:6] == pytest.approx(60.0 * 0.0827)
    assert torque[6:] == pytest.approx(-60.0 * 0.0827)


def test_overspeed_disarms_in_torque_mode_and_axis_error_names_the_cause() -> None:
    bank = make_bank()
    bank.input_torque[:] = 1.0
    speed = np.zeros(12)
    speed[3] = 80.0  # beyond 1.2 * 60 turn/s
    torque = ZERO
    for k in range(1, 30):
        torque = bank.step(k * DT, speed * k * DT, speed)
    heartbeat = bank.heartbeat(3)
    assert torque[3] == 0.0
    assert torque[2] == 1.0
    assert heartbeat.axis_state == AxisState.IDLE
    assert heartbeat.axis_error == AxisError.CONTROLLER_FAILED | AxisError.MOTOR_FAILED
    assert heartbeat.controller_failed
    assert heartbeat.motor_failed


def test_an_idle_axis_spun_too_fast_has_the_error_once_it_has_been_armed() -> None:
    bank = AxisBank(DRIVE, encoder_counts_per_turn=CPR, watchdog=False)
    bank.step(0.0, ZERO, ZERO)
    bank.request_state(3, AxisState.CLOSED_LOOP_CONTROL)
    bank.request_state(3, AxisState.IDLE)
    speed = np.full(12, 80.0)
    for k in range(1, 30):
        bank.step(k * DT, speed * k * DT, speed)
    assert [axis for axis in range(12) if bank.faults[axis] != AxisErrors()] == [3]
    assert bank.faults[3].controller == ControllerError.OVERSPEED


def test_position_mode_set_again_makes_where_the_motor_is_its_target() -> None:
    bank = make_bank(ControlMode.POSITION, turns=2.0)
    bank.input_pos[:] = 5.0
    bank.set_modes(1, ControlMode.POSITION, InputMode.PASSTHROUGH)
    bank.set_modes(2, ControlMode.VELOCITY, InputMode.PASSTHROUGH)
    assert list(bank.input_pos[:3]) == [5.0, 2.0, 5.0]


def test_speed_below_the_tolerance_keeps_the_axis_armed() -> None:
    bank = make_bank()
    speed = np.full(12, 65.0)
    for k in range(1, 100):
        bank.step(k * DT, speed * k * DT, speed)
    assert bank.state == [AxisState.CLOSED_LOOP_CONTROL] * 12


def test_starved_watchdog_floats_the_axis_and_the_sibling_keeps_its_torque() -> None:
    bank = make_bank(watchdog=True)
    bank.input_torque[:] = 2.0
    torque = ZERO
    for k in range(1, 151):
        for axis in range(1, 12):
            bank.feed(axis)
        torque = bank.step(k * DT, ZERO, ZERO)
        if k == 90:
            assert torque[0] == 2.0
    assert torque[0] == 0.0
    assert torque[1:] == pytest.approx(2.0)
    assert bank.heartbeat(0).axis_error == AxisError.WATCHDOG_TIMER_EXPIRED
    assert bank.heartbeat(0).axis_state == AxisState.IDLE
    assert bank.heartbeat(1).axis_error == 0


def test_watchdog_that_is_off_never_disarms() -> None:
    bank = make_bank(watchdog=False)
    bank.input_torque[:] = 2.0
    assert bank.step(1000.0, ZERO, ZERO) == pytest.approx(2.0)


def test_closed_loop_is_refused_while_an_error_stands() -> None:
    bank = make_bank()
    bank.inject("knee_right.axis1", "DRV_FAULT")
    bank.request_state(3, AxisState.CLOSED_LOOP_CONTROL)
    assert bank.state[3] == AxisState.IDLE
    bank.clear_errors(2)  # through the sibling: the firmware clears the whole ODrive
    bank.request_state(3, AxisState.CLOSED_LOOP_CONTROL)
    assert bank.state[3] == AxisState.CLOSED_LOOP_CONTROL


def test_rearming_brings_back_the_old_input_torque() -> None:
    bank = make_bank()
    bank.input_torque[5] = 1.25
    bank.request_state(5, AxisState.IDLE)
    assert bank.step(DT, ZERO, ZERO)[5] == 0.0
    bank.request_state(5, AxisState.CLOSED_LOOP_CONTROL)
    assert bank.step(2 * DT, ZERO, ZERO)[5] == 1.25


def test_position_mode_is_entered_without_a_jump() -> None:
    bank = AxisBank(DRIVE, encoder_counts_per_turn=CPR, watchdog=False)
    pos = np.full(12, 3.7)
    bank.step(0.0, pos, ZERO)
    bank.request_state(0, AxisState.CLOSED_LOOP_CONTROL)
    assert bank.step(DT, pos, ZERO)[0] == pytest.approx(0.0, abs=1e-9)


def test_state_that_is_not_emulated_is_invalid_and_leads_to_idle() -> None:
    bank = make_bank()
    bank.request_state(7, AxisState.HOMING)
    assert bank.state[7] == AxisState.IDLE
    assert bank.heartbeat(7).axis_error == AxisError.INVALID_STATE


def test_reboot_restarts_both_axes_of_one_odrive_only() -> None:
    bank = make_bank()
    bank.input_torque[:] = 1.0
    bank.reboot(5)
    torque = bank.step(DT, ZERO, ZERO)
    assert list(np.flatnonzero(torque == 0.0)) == [4, 5]
    assert bank.input_torque[4] == bank.input_torque[5] == 0.0


@pytest.mark.parametrize("fault", FAULTS)
def test_injected_fault_floats_that_axis_alone(fault: str) -> None:
    bank = make_bank()
    bank.input_torque[:] = 1.0
    bank.inject("hip_left.axis0", fault)
    torque = bank.step(DT, ZERO, ZERO)
    assert AXIS_NAMES[10] == "hip_left.axis0"
    assert torque[10] == 0.0
    assert np.delete(torque, 10) == pytest.approx(1.0)
    assert (bank.heartbeat(10).errors == 0) == (fault == "DISARM")


def test_unknown_axis_or_fault_is_refused_with_the_names_there_are() -> None:
    bank = make_bank()
    with pytest.raises(DriveError, match=r"hip_left\.axis1"):
        bank.inject("hip_middle.axis0", "DISARM")
    with pytest.raises(DriveError, match="OVERSPEED"):
        bank.inject("hip_left.axis0", "FIRE")


def test_position_estimate_settles_on_the_count_below_the_true_position() -> None:
    bank = make_bank()
    for k in range(1, 40):
        bank.step(k * DT, np.full(12, 0.70001), ZERO)
    assert bank.pos_estimate * CPR == pytest.approx(math.floor(0.70001 * CPR), abs=1e-6)
    assert bank.encoder_turns * CPR == pytest.approx(math.floor(0.70001 * CPR))


def test_velocity_estimate_follows_a_step_as_the_firmware_pll_does() -> None:
    """The same filter stepped at 80 kHz on the unquantised ramp is the reference."""
    bank = make_bank()
    speed, fine = 10.0, 80
    pos_hat = vel_hat = 0.0
    worst = 0.0
    for k in range(1, 21):
        for j in range(1, fine + 1):
            h = DT / fine
            true = speed * ((k - 1) * DT + j * h)
            pos_hat += h * vel_hat
            error = true - pos_hat
            pos_hat += h * 2000.0 * error
            vel_hat += h * 1e6 * error
        bank.step(k * DT, np.full(12, speed * k * DT), np.full(12, speed))
        worst = max(worst, abs(float(bank.vel_estimate[0]) - vel_hat))
    assert vel_hat == pytest.approx(speed, rel=1e-3)
    assert worst < 0.15  # one count per millisecond is 0.06 turn/s; the start differs by Euler


def test_estimators_start_at_the_true_state() -> None:
    bank = AxisBank(DRIVE, encoder_counts_per_turn=CPR)
    bank.step(5.0, np.full(12, 2.0), np.full(12, 3.0))
    assert bank.vel_estimate == pytest.approx(3.0)
    bank.step(5.001, np.full(12, 2.003), np.full(12, 3.0))
    assert bank.vel_estimate == pytest.approx(3.0, abs=0.1)


def test_a_drive_that_was_zeroed_counts_from_its_mark() -> None:
    drive = msgspec.structs.replace(DRIVE, zero_mark_turns=64.0)
    bank = AxisBank(drive, encoder_counts_per_turn=CPR)
    bank.step(0.0, np.full(12, -3.25), ZERO)
    np.testing.assert_allclose(bank.pos_estimate, 64.0 - 3.25)


def test_a_drive_that_got_power_knows_where_it_is_within_a_turn() -> None:
    bank = AxisBank(DRIVE, encoder_counts_per_turn=CPR, zeroed=False)
    bank.step(0.0, np.linspace(-9.3, 9.2, 12), ZERO)
    within = (np.linspace(-9.3, 9.2, 12) + 0.5) % 1.0 - 0.5
    np.testing.assert_allclose(bank.pos_estimate, within, atol=1e-4)


def test_a_restart_loses_the_whole_turns_and_only_of_its_own_drive() -> None:
    drive = msgspec.structs.replace(DRIVE, zero_mark_turns=64.0)
    bank = AxisBank(drive, encoder_counts_per_turn=CPR)
    bank.step(0.0, np.full(12, 5.75), ZERO)
    bank.reboot(4)
    bank.step(DT, np.full(12, 5.75), ZERO)
    assert bank.pos_estimate[[4, 5]] == pytest.approx([-0.25, -0.25])
    assert np.delete(bank.pos_estimate, [4, 5]) == pytest.approx([69.75] * 10)


def test_a_count_that_was_set_is_counted_on_from_without_a_jump_in_velocity() -> None:
    bank = AxisBank(DRIVE, encoder_counts_per_turn=CPR)
    bank.step(0.0, ZERO, ZERO)
    bank.set_count(3, 64.5 * CPR)
    for k in range(1, 200):
        bank.step(k * DT, np.full(12, 1e-3 * k), ZERO)
    assert bank.pos_estimate[3] == pytest.approx(64.5 + 0.199, abs=2e-3)
    assert bank.vel_estimate[3] == pytest.approx(bank.vel_estimate[2])


def test_a_lost_encoder_comes_back_where_it_was_set_since() -> None:
    drive = msgspec.structs.replace(DRIVE, zero_mark_turns=64.0)
    bank = AxisBank(drive, encoder_counts_per_turn=CPR)
    bank.step(0.0, ZERO, ZERO)
    bank.conditions.lose_encoder(2, lost=True)
    bank.step(DT, ZERO, ZERO)
    assert bank.pos_estimate[2] == 64.0, "it reads what it did"
    bank.set_count(2, 0.0)
    bank.conditions.lose_encoder(2, lost=False)
    bank.step(2 * DT, ZERO, ZERO)
    assert bank.pos_estimate[2] == pytest.approx(0.0, abs=1e-3)
