"""The emulated drives: states, errors, watchdogs, counts, and the firmware's traps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.drives.axis_bank import AXIS_NAMES, FAULTS, AxisBank, AxisErrors
from services.simulator.drives.axis_settings import PHASE_INDUCTANCE
from shared.can.cansimple import AxisError, AxisState, ControllerError, ControlMode, InputMode
from shared.exceptions import DriveError
from tests.simulator.banks import (
    CLOSED_LOOP,
    CPR,
    DT,
    IDLE,
    ZERO,
    idle_bank,
    make_bank,
    step_for,
)


def test_overspeed_disarms_in_torque_mode_and_axis_error_names_the_cause() -> None:
    bank = make_bank()
    bank.input_torque[:] = 1.0
    speed = np.zeros(12)
    speed[3] = 80.0  # beyond 1.2 * 60 turn/s
    torque = step_for(bank, 0.03, vel=speed)
    heartbeat = bank.heartbeat(3)
    assert (torque[3], torque[2]) == (0.0, 1.0)
    assert heartbeat.axis_state == IDLE
    assert heartbeat.axis_error == AxisError.CONTROLLER_FAILED | AxisError.MOTOR_FAILED
    assert heartbeat.controller_failed
    assert heartbeat.motor_failed


def test_an_idle_axis_spun_too_fast_has_the_error_once_it_has_been_armed() -> None:
    bank = idle_bank(watchdog=False)
    bank.request_state(3, CLOSED_LOOP)
    bank.request_state(3, IDLE)
    step_for(bank, 0.03, vel=np.full(12, 80.0))
    assert [axis for axis in range(12) if bank.faults[axis] != AxisErrors()] == [3]
    assert bank.faults[3].controller == ControllerError.OVERSPEED
    assert bank.heartbeat(3).axis_error == AxisError.CONTROLLER_FAILED, "no motor missed a command"


def test_speed_below_the_tolerance_keeps_the_axis_armed() -> None:
    bank = make_bank()
    bank.settings.fill("motor.config.current_lim_margin", math.inf)  # it starts at speed
    step_for(bank, 0.1, vel=np.full(12, 65.0))
    assert bank.state == [CLOSED_LOOP] * 12


def test_position_mode_set_again_makes_where_the_motor_is_its_target() -> None:
    bank = make_bank(ControlMode.POSITION, turns=2.0)
    bank.input_pos[:] = 5.0
    bank.set_modes(1, ControlMode.POSITION, InputMode.PASSTHROUGH)
    bank.set_modes(2, ControlMode.VELOCITY, InputMode.PASSTHROUGH)
    assert list(bank.input_pos[:3]) == [5.0, 2.0, 5.0]


def test_starved_watchdog_floats_the_axis_and_the_sibling_keeps_its_torque() -> None:
    bank = make_bank(watchdog=True)
    bank.input_torque[:] = 2.0
    torque = ZERO
    for k in range(1, 151):
        for axis in range(1, 12):
            bank.feed(axis)
        torque = bank.step(k * DT, ZERO, ZERO)
        assert k > 90 or torque[0] == 2.0
    assert torque[0] == 0.0
    assert torque[1:] == pytest.approx(2.0)
    assert bank.heartbeat(0).axis_error == AxisError.WATCHDOG_TIMER_EXPIRED
    assert bank.heartbeat(0).axis_state == IDLE
    assert bank.heartbeat(1).axis_error == 0


def test_closed_loop_with_an_error_is_state_8_for_1_ms_without_torque_and_moves_the_target() -> (
    None
):
    bank, at = make_bank(ControlMode.POSITION, turns=2.0), ZERO + 2.0
    bank.inject("knee_right.axis1", "SPINOUT")
    bank.input_pos[3] = 5.0
    bank.request_state(3, CLOSED_LOOP)
    assert (bank.state[3], bank.input_pos[3]) == (CLOSED_LOOP, 2.0)
    bank.input_pos[3] = 1.0
    assert step_for(bank, DT, at)[3] == 0.0
    assert bank.state[3] == IDLE
    bank.clear_errors(2)  # through the sibling: the firmware clears the whole ODrive
    bank.request_state(3, CLOSED_LOOP)
    assert step_for(bank, 10 * DT, at)[3] == 0.0, "entered without a jump"
    bank.input_pos[3] = 1.0
    assert step_for(bank, 10 * DT, at)[3] != 0.0
    assert bank.state[3] == CLOSED_LOOP


def test_closed_loop_asked_for_twice_lets_go_for_a_quarter_of_a_millisecond() -> None:
    bank = make_bank(ControlMode.POSITION)
    bank.input_torque[:] = 1.0
    step_for(bank, DT)
    bank.input_pos[4] = 3.0
    bank.request_state(4, CLOSED_LOOP)
    assert bank.input_pos[4] == 0.0
    torque = bank.step(bank.now_s + DT, ZERO, ZERO)
    assert (torque[4], torque[5]) == pytest.approx((0.75, 1.0))
    assert step_for(bank, DT)[4] == 1.0


@pytest.mark.parametrize(
    ("state", "becomes"), [(264, CLOSED_LOOP), (257, IDLE), (512, CLOSED_LOOP)]
)
def test_a_state_is_its_low_byte(state: int, becomes: AxisState) -> None:
    bank = make_bank()
    bank.request_state(7, IDLE if becomes == CLOSED_LOOP and state != 512 else CLOSED_LOOP)
    bank.request_state(7, state)
    assert bank.state[7] == becomes
    assert bank.faults[7] == AxisErrors()


@pytest.mark.parametrize(("lifting", "spins"), [(40.0, True), (2.0, False)])
def test_disarmed_while_it_lifts_an_axis_that_sinks_spins_out_in_idle(
    lifting: float, spins: bool
) -> None:
    """1 N m at 40 turn/s are 251 W, at 2 turn/s 13 W; the thresholds are 100 W."""
    bank = make_bank(ControlMode.POSITION)
    bank.settings.fill("motor.config.current_lim_margin", math.inf)
    bank.vel_gain[:] = 0.1
    bank.pos_gain[:] = 0.0
    vel = np.zeros(12)
    vel[4] = lifting
    bank.input_vel[4], bank.input_torque[4] = lifting, 1.0
    step_for(bank, 0.3, vel=vel)
    bank.estop(4)
    assert bank.heartbeat(4).axis_error == AxisError.ESTOP_REQUESTED
    bank.input_vel[4] = 0.0
    step_for(bank, 0.2, pos=0.3 * vel, vel=np.where(vel > 0.0, -30.0, 0.0))
    assert bank.heartbeat(4).axis_error == (0x4200 if spins else 0x4000)
    assert bool(bank.faults[4].controller & ControllerError.SPINOUT_DETECTED) == spins


# ---- watchdogs


def test_a_watchdog_enabled_before_it_was_fed_expires_at_once_whatever_its_timeout() -> None:
    bank = idle_bank(watchdog=False)
    bank.settings.fill("config.watchdog_timeout", 0.0)
    bank.settings.save(1)
    bank.reboot(2)
    step_for(bank, 1.6)
    bank.settings.set(1, "axis0.config.enable_watchdog", value=True)
    bank.settings.set(1, "axis0.config.watchdog_timeout", 5.0)
    bank.settings.set(1, "axis1.config.watchdog_timeout", 5.0)
    bank.feed(3)
    bank.settings.set(1, "axis1.config.enable_watchdog", value=True)
    step_for(bank, 2 * DT)
    assert bank.heartbeat(2).axis_error == AxisError.WATCHDOG_TIMER_EXPIRED
    step_for(bank, 1.0)
    assert bank.heartbeat(3).axis_error == 0


def test_a_watchdog_that_is_off_does_not_count_down() -> None:
    bank = make_bank(watchdog=True)
    step_for(bank, 0.06)
    for on in (False, True):
        bank.settings.set(0, "axis0.config.enable_watchdog", value=on)
        step_for(bank, 0.03)
    assert bank.state[:2] == [CLOSED_LOOP, IDLE], "0.04 s were left"
    step_for(bank, 0.02)
    assert bank.state[0] == IDLE


def test_state_that_is_not_emulated_is_invalid_and_leads_to_idle() -> None:
    bank = make_bank()
    bank.request_state(7, AxisState.HOMING)
    assert bank.state[7] == IDLE
    assert bank.heartbeat(7).axis_error == AxisError.INVALID_STATE


def test_reboot_restarts_both_axes_of_one_odrive_only() -> None:
    bank = make_bank()
    bank.input_torque[:] = 1.0
    bank.reboot(5)
    assert list(np.flatnonzero(step_for(bank, DT) == 0.0)) == [4, 5]
    assert bank.input_torque[4] == bank.input_torque[5] == 0.0


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_an_injected_fault_floats_that_axis_alone_but_where_gate_drivers_share_it(
    fault: str,
) -> None:
    bank = make_bank()
    bank.input_torque[:] = 1.0
    bank.inject("hip_left.axis0", fault)
    torque = step_for(bank, DT)
    assert AXIS_NAMES[10] == "hip_left.axis0"
    floating = [10, 11] if fault == "DRV_FAULT" else [10]
    assert list(np.flatnonzero(torque == 0.0)) == floating
    assert np.delete(torque, floating) == pytest.approx(1.0)
    assert [bank.faults[axis] for axis in floating] == [FAULTS[fault]] * len(floating)
    assert (bank.heartbeat(10).errors == 0) == (fault == "DISARM")


# ---- the current


def heavy_bank(torque: float, **limits: float) -> AxisBank:
    """Return a bank with a torque on all axes for long enough that the current is there."""
    bank = make_bank()
    for name, value in limits.items():
        getattr(bank, name)[:] = value
    bank.vel_gain[:] = 100.0  # else the velocity limit of torque mode clamps first
    bank.input_torque[:] = torque
    step_for(bank, 0.01)
    return bank


@pytest.mark.parametrize(("lowered_to", "disarms"), [(30.0, False), (20.0, True), (10.0, True)])
def test_a_current_limit_lowered_under_load_disarms_beyond_8_a(
    lowered_to: float, disarms: bool
) -> None:
    """38 A flow; a cycle later an eighth of the difference is gone, and 8 A are allowed."""
    bank = heavy_bank(38.0 * 0.0827, current_lim=40.0)
    bank.current_lim[3] = lowered_to
    step_for(bank, DT)
    assert (bank.state[3] == IDLE) == disarms
    assert bank.faults[3] == (FAULTS["CURRENT_LIMIT"] if disarms else AxisErrors())
    assert bank.state[2] == CLOSED_LOOP


@pytest.mark.parametrize(("speed", "disarms"), [(2.0, False), (8.0, True)])
def test_a_bump_under_load_disarms_where_the_emf_drives_the_current_beyond_its_limit(
    speed: float, disarms: bool
) -> None:
    """Thrown to a speed within a step at full current; without a load neither does."""
    for torque, limp in ((-40.0 * 0.0827, disarms), (0.0, False)):
        bank = heavy_bank(torque, current_lim=40.0)
        bumped = np.zeros(12)
        bumped[4] = speed
        step_for(bank, 0.005, vel=bumped)
        assert (bank.faults[4] == FAULTS["CURRENT_LIMIT"]) == limp


def test_the_current_that_an_emf_drives_is_that_of_the_loop_at_its_own_rate() -> None:
    """Winding and PI loop of the firmware at 8 kHz, against the bank's step of a millisecond."""
    bank = make_bank()
    bank.settings.fill("motor.config.current_lim_margin", math.inf)
    loops = bank._control._loops.reshape(5, 12)
    rng = np.random.default_rng(5)
    kt, resistance, inductance, w = 0.0827, 0.1, PHASE_INDUCTANCE, 1000.0
    fine = 64
    period, current, integral, speed, worst, largest = 1.0 / 8000.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(1, 200):
        target = speed + rng.normal(0.0, 1.0)
        for cycle in range(8):
            volts = -current * w * inductance + integral
            integral -= current * w * resistance * period
            for sub in range(fine):
                at = speed + (target - speed) * (cycle + sub / fine) / 8.0
                emf = 2.0 / 3.0 * kt * 2.0 * math.pi * at
                slope = (volts - resistance * current - emf) / inductance
                current += slope * period / fine
        speed = target
        bank.step(k * DT, ZERO, np.full(12, speed))
        worst = max(worst, abs(loops[2, 0] - current))
        largest = max(largest, abs(current))
    assert largest > 4.0
    assert worst < 0.15 * largest


@pytest.mark.parametrize(
    ("axis", "fault", "says"),
    [
        ("hip_middle.axis0", "DISARM", r"hip_left\.axis1"),
        ("hip_left.axis0", "FIRE", "OVERSPEED"),
    ],
)
def test_unknown_axis_or_fault_is_refused_with_the_names_there_are(
    axis: str, fault: str, says: str
) -> None:
    with pytest.raises(DriveError, match=says):
        make_bank().inject(axis, fault)


# ---- encoders


def test_position_estimate_settles_on_the_count_below_the_true_position() -> None:
    bank = make_bank()
    step_for(bank, 0.04, pos=np.full(12, 0.70001))
    assert bank.pos_estimate * CPR == pytest.approx(math.floor(0.70001 * CPR), abs=1e-6)
    assert bank.encoder_turns * CPR == pytest.approx(math.floor(0.70001 * CPR))


@pytest.mark.parametrize("turns", [5.75, -9.3, 9.2])
def test_a_drive_counts_from_its_mark_and_after_a_restart_by_its_encoders_own_angle(
    turns: float,
) -> None:
    bank = idle_bank(np.full(12, turns), mark=64.0)
    np.testing.assert_allclose(bank.pos_estimate, 64.0 + turns, atol=1e-4)
    bank.reboot(4)
    step_for(bank, DT, pos=np.full(12, turns))
    own = turns + bank.encoder_mount[[4, 5]] / CPR
    assert bank.pos_estimate[[4, 5]] == pytest.approx(own - np.round(own), abs=1e-4)
    assert np.delete(bank.pos_estimate, [4, 5]) == pytest.approx([64.0 + turns] * 10, abs=1e-4)


def test_a_count_that_was_set_is_counted_on_from_without_a_jump_in_velocity() -> None:
    bank = idle_bank()
    bank.set_count(3, 64.5 * CPR)
    step_for(bank, 0.2, vel=np.full(12, 1.0))
    assert bank.pos_estimate[3] == pytest.approx(64.5 + 0.2, abs=2e-3)
    assert bank.vel_estimate[3] == pytest.approx(bank.vel_estimate[2])
