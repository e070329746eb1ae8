"""The emulated drives: states, watchdogs, currents, counts, settings, heat, supply, and traps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_faults import AXIS_NAMES, FAULTS, AxisErrors
from services.simulator.drives.axis_heat import Heat
from services.simulator.drives.axis_settings import (
    NAMES,
    PHASE_RESISTANCE,
    Settings,
    configured,
)
from services.simulator.drives.dc_bus import SUPPLY_RESISTANCE, SUPPLY_VOLTAGE
from shared.can.cansimple import (
    AxisError,
    ControllerError,
    ControlMode,
    InputMode,
    MotorError,
    OdriveError,
)
from tests.simulator.banks import (
    CLOSED_LOOP,
    CPR,
    DRIVE,
    DT,
    IDLE,
    KT,
    ZERO,
    close_loop,
    idle_bank,
    make_bank,
    only,
    step_for,
)


def patient_bank(mode: ControlMode = ControlMode.TORQUE, torque: float = 0.0) -> AxisBank:
    """Return an armed bank whose measured current may be off by anything."""
    bank = make_bank(mode, torque=torque)
    bank.settings.fill("motor.config.current_lim_margin", math.inf)
    return bank


def test_overspeed_disarms_an_axis_and_marks_an_idle_one_that_has_been_armed() -> None:
    bank = make_bank(torque=1.0)
    torque = step_for(bank, 0.03, vel=only(3, 80.0))  # the limit is 1.2 * 60 turn/s
    heartbeat = bank.heartbeat(3)
    assert (torque[3], torque[2], heartbeat.axis_state) == (0.0, 1.0, IDLE)
    assert heartbeat.axis_error == AxisError.CONTROLLER_FAILED | AxisError.MOTOR_FAILED
    assert (heartbeat.controller_failed, heartbeat.motor_failed) == (True, True)
    idle = idle_bank(watchdog=False)
    idle.request_state(3, CLOSED_LOOP)
    idle.request_state(3, IDLE)
    step_for(idle, 0.03, vel=np.full(12, 80.0))
    assert [axis for axis in range(12) if idle.faults[axis] != AxisErrors()] == [3]
    assert idle.faults[3].controller == ControllerError.OVERSPEED
    assert idle.heartbeat(3).axis_error == AxisError.CONTROLLER_FAILED, "no motor lacks a command"
    slower = patient_bank()
    step_for(slower, 0.1, vel=np.full(12, 65.0))
    assert slower.state == [CLOSED_LOOP] * 12


def test_a_position_mode_or_closed_loop_set_again_takes_the_present_position() -> None:
    bank = make_bank(ControlMode.POSITION, turns=2.0)
    bank.input_pos[:] = 5.0
    bank.set_modes(1, ControlMode.POSITION, InputMode.PASSTHROUGH)
    bank.set_modes(2, ControlMode.VELOCITY, InputMode.PASSTHROUGH)
    assert list(bank.input_pos[:3]) == [5.0, 2.0, 5.0]
    bank = make_bank(ControlMode.POSITION, torque=1.0)
    step_for(bank, DT)
    bank.input_pos[4] = 3.0
    bank.request_state(4, CLOSED_LOOP)
    assert bank.input_pos[4] == 0.0
    assert step_for(bank, DT)[4:6] == pytest.approx((0.75, 1.0))
    assert step_for(bank, DT)[4] == 1.0


def test_closed_loop_with_an_error_lasts_1_ms_without_torque_and_moves_the_target() -> None:
    bank, at = make_bank(ControlMode.POSITION, turns=2.0), ZERO + 2.0
    bank.inject("knee_right.axis1", "SPINOUT")
    bank.input_pos[3] = 5.0
    bank.request_state(3, CLOSED_LOOP)
    assert (bank.state[3], bank.input_pos[3]) == (CLOSED_LOOP, 2.0)
    bank.input_pos[3] = 1.0
    assert (step_for(bank, DT, at)[3], bank.state[3]) == (0.0, IDLE)
    bank.clear_errors(2)  # through the sibling: the firmware clears the whole ODrive
    bank.request_state(3, CLOSED_LOOP)
    assert step_for(bank, 10 * DT, at)[3] == 0.0, "entered without a jump"
    bank.input_pos[3] = 1.0
    assert step_for(bank, 10 * DT, at)[3] != 0.0
    assert bank.state[3] == CLOSED_LOOP


@pytest.mark.parametrize(("lifting", "spins"), [(40.0, True), (2.0, False)])
def test_disarmed_while_it_lifts_an_axis_that_sinks_spins_out_in_idle(
    lifting: float, spins: bool
) -> None:
    """1 N m at 40 turn/s are 251 W, at 2 turn/s 13 W; the thresholds are 100 W."""
    bank = patient_bank(ControlMode.POSITION)
    bank.vel_gain[:], bank.pos_gain[:] = 0.1, 0.0
    bank.input_vel[4], bank.input_torque[4] = lifting, 1.0
    step_for(bank, 0.3, vel=only(4, lifting))
    bank.estop(4)
    assert bank.heartbeat(4).axis_error == AxisError.ESTOP_REQUESTED
    bank.input_vel[4] = 0.0
    step_for(bank, 0.2, pos=only(4, 0.3 * lifting), vel=only(4, -30.0))
    assert bank.heartbeat(4).axis_error == (0x4200 if spins else 0x4000)
    assert bool(bank.faults[4].controller & ControllerError.SPINOUT_DETECTED) == spins


def test_a_starved_watchdog_floats_its_axis_alone_and_counts_only_while_it_is_on() -> None:
    bank = make_bank(watchdog=True, torque=2.0)
    for k in range(1, 151):
        for axis in range(1, 12):
            bank.feed(axis)
        torque = step_for(bank, DT)
        assert k > 90 or torque[0] == 2.0
    assert (torque[0], *bank.heartbeat(0)[:2]) == (0.0, AxisError.WATCHDOG_TIMER_EXPIRED, IDLE)
    assert torque[1:] == pytest.approx(2.0)
    assert bank.heartbeat(1).axis_error == 0
    paused = make_bank(watchdog=True)
    step_for(paused, 0.06)
    for on in (False, True):
        paused.settings.set(0, "axis0.config.enable_watchdog", value=on)
        step_for(paused, 0.03)
    assert paused.state[:2] == [CLOSED_LOOP, IDLE], "0.04 s were left"
    step_for(paused, 0.02)
    assert paused.state[0] == IDLE


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_an_injected_fault_floats_its_axis_alone_but_where_gate_drivers_share_it(
    fault: str,
) -> None:
    bank = make_bank(torque=1.0)
    bank.inject("hip_left.axis0", fault)
    torque = step_for(bank, DT)
    assert AXIS_NAMES[10] == "hip_left.axis0"
    floating = [10, 11] if fault == "DRV_FAULT" else [10]
    assert list(np.flatnonzero(torque == 0.0)) == floating
    assert np.delete(torque, floating) == pytest.approx(1.0)
    assert [bank.faults[axis] for axis in floating] == [FAULTS[fault]] * len(floating)
    assert (bank.heartbeat(10).errors == 0) == (fault == "DISARM")


# ---- the current


def heavy_bank(torque: float) -> AxisBank:
    """Return a bank limited to 40 A, with a torque on all axes until the current flows."""
    bank = make_bank(torque=torque)
    bank.current_lim[:] = 40.0
    bank.vel_gain[:] = 100.0  # else the velocity limit of torque mode clamps first
    step_for(bank, 0.01)
    return bank


@pytest.mark.parametrize(("lowered_to", "disarms"), [(30.0, False), (20.0, True), (10.0, True)])
def test_a_current_limit_lowered_under_load_disarms_beyond_8_a(
    lowered_to: float, disarms: bool
) -> None:
    """38 A flow; a cycle later an eighth of the difference is gone, and 8 A are allowed."""
    bank = heavy_bank(38.0 * KT)
    bank.current_lim[3] = lowered_to
    step_for(bank, DT)
    assert (bank.state[3], bank.state[2]) == (IDLE if disarms else CLOSED_LOOP, CLOSED_LOOP)
    assert bank.faults[3] == (FAULTS["CURRENT_LIMIT"] if disarms else AxisErrors())


# ---- encoders and restarts


def test_the_estimate_settles_on_the_count_below_and_goes_on_from_one_that_was_set() -> None:
    bank = make_bank()
    step_for(bank, 0.04, pos=np.full(12, 0.70001))
    assert bank.pos_estimate * CPR == pytest.approx(math.floor(0.70001 * CPR), abs=1e-6)
    assert bank.encoder_turns * CPR == pytest.approx(math.floor(0.70001 * CPR))
    bank = idle_bank()
    bank.set_count(3, 64.5 * CPR)
    step_for(bank, 0.2, vel=np.full(12, 1.0))
    assert bank.pos_estimate[3] == pytest.approx(64.5 + 0.2, abs=2e-3)
    assert bank.vel_estimate[3] == pytest.approx(bank.vel_estimate[2])


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


def test_a_reboot_restarts_both_axes_of_one_odrive_with_what_was_saved() -> None:
    bank = make_bank(torque=1.0)
    bank.settings.set(1, "axis0.controller.config.vel_limit", 5.0)
    bank.settings.save(1)
    bank.settings.set(1, "axis0.controller.config.vel_limit", 9.0)
    bank.settings.set(1, "axis1.motor.config.current_lim", 1.0)
    bank.reboot(3)
    assert (bank.vel_limit[2], bank.current_lim[3]) == (5.0, 60.0)
    assert list(np.flatnonzero(step_for(bank, DT) == 0.0)) == [2, 3]
    assert bank.input_torque[2] == bank.input_torque[3] == 0.0


# ---- settings


def test_a_setting_has_its_own_drive_name_and_type() -> None:
    settings, name = Settings(), "axis1.controller.config.vel_limit"
    settings.set(2, name, 7)
    settings.set(2, "axis1.config.enable_watchdog", 1)
    assert (settings.get(2, name), settings.get(1, name)) == (7.0, 2.0)
    assert settings.get(2, "axis1.config.enable_watchdog") is True
    assert settings.get(2, "axis0.controller.config.vel_limit") == 2.0
    assert settings.axis("controller.config.vel_limit")[5] == 7.0
    table = configured(DRIVE, encoder_counts_per_turn=CPR).table(0)
    assert tuple(table) == NAMES
    assert isinstance(table["axis0.motor.config.pole_pairs"], int)
    assert isinstance(table["axis0.motor.config.pre_calibrated"], bool)
    assert isinstance(table["config.brake_resistance"], float)
    assert math.isinf(float(table["config.dc_max_positive_current"]))


def test_the_bank_acts_on_a_setting_from_the_next_step_on() -> None:
    bank = make_bank(torque=2.0)
    bank.settings.set(0, "axis1.motor.config.current_lim", 10.0)
    assert step_for(bank, DT)[:2] == pytest.approx([2.0, 10.0 * KT])
    bank.settings.set(0, "axis0.config.enable_watchdog", value=True)
    bank.settings.set(1, "axis0.encoder.config.cpr", CPR // 2)
    step_for(bank, 0.12)
    assert bank.state[:2] == [IDLE, CLOSED_LOOP]
    step_for(bank, 0.1, pos=np.full(12, 0.5))
    assert bank.pos_estimate[2:4] == pytest.approx([1.0, 0.5], abs=1e-3), "a wrong scale"


# ---- heat

HALF = 0.5 * 60.0 * KT


def loaded_bank(heat: Heat | None = None) -> AxisBank:
    """Return an armed bank that is asked for more torque than its limit."""
    bank = idle_bank(watchdog=False, heat=heat)
    close_loop(bank, ControlMode.TORQUE)
    bank.vel_gain[:] = 10.0  # else the velocity limit of torque mode clamps first
    bank.input_torque[:] = 99.0
    return bank


def test_a_stage_heated_at_once_derates_and_disarms_half_a_second_later() -> None:
    bank = loaded_bank()
    bank.heat.force(3, 130.0)
    torques = [0.0]
    while bank.state[3] is CLOSED_LOOP:
        torques.append(float(step_for(bank, DT)[3]))
        assert len(torques) < 700
    x = 0.478  # both low-passes: 1 - (1 + t / tau) exp(-t / tau) = 100 / 105
    assert 1.0 - (1.0 + x / 0.1) * math.exp(-x / 0.1) == pytest.approx(100.0 / 105.0, abs=2e-3)
    assert (len(torques) - 1) * DT == pytest.approx(x, abs=0.02)
    half = next(k for k, torque in enumerate(torques) if k and torque < HALF)
    assert half * DT == pytest.approx(0.33, abs=0.03), "it derates before it disarms"
    assert torques[-1] == 0.0
    assert bank.faults[3].motor == MotorError.FET_THERMISTOR_OVER_TEMP
    assert bank.state[2] is CLOSED_LOOP


@pytest.mark.parametrize("enabled", [False, True])
def test_a_motors_thermistor_counts_once_it_is_enabled(enabled: bool) -> None:
    bank = loaded_bank(Heat(ambient=40.0, warm=59.0, motor_thermistor=True))
    bank.settings.fill("motor.motor_thermistor.config.enabled", enabled)
    bank.settings.fill("motor.fet_thermistor.config.enabled", False)
    shares = {}
    for k in range(108):  # slowly: a limit that jumps down is a current violation
        celsius = 99.0 + 0.25 * k
        bank.heat.winding[5] = celsius
        step_for(bank, 0.1)
        shares[celsius] = bank.heat._control.derating[5]
    assert shares[110.0] == pytest.approx(0.5 if enabled else 1.0, abs=0.1)
    assert (bank.faults[5].motor == MotorError.MOTOR_THERMISTOR_OVER_TEMP) is enabled


# ---- the supply

FAST = only(4, 20.0)
"""turn/s of axis0 of hip_right."""


@pytest.mark.parametrize("torque", [1.0, -1.0, -3.0, 0.0])
def test_the_bus_current_is_that_of_mechanical_power_and_copper_losses(torque: float) -> None:
    bank = make_bank()
    bank.input_torque[4] = torque
    step_for(bank, 0.03, vel=FAST)
    copper = 1.5 * PHASE_RESISTANCE * (torque / KT) ** 2
    power, voltage = torque * 2.0 * math.pi * FAST[4] + copper, SUPPLY_VOLTAGE
    for _ in range(50):  # V = supply - R P / V, by repetition
        voltage = SUPPLY_VOLTAGE - SUPPLY_RESISTANCE * power / voltage
    assert bank.bus.state(2)[0] == pytest.approx(voltage, abs=0.01)
    assert bank.bus.state(2)[1] == pytest.approx(power / voltage, abs=0.05)
    assert bank.bus.state(3) == (SUPPLY_VOLTAGE, 0.0)


@pytest.mark.parametrize(
    ("resistance", "setting", "limit", "torque", "error"),
    [
        (10.0, "positive", math.inf, -1.0, OdriveError.DC_BUS_OVER_VOLTAGE),
        (SUPPLY_RESISTANCE, "positive", 5.0, 3.0, OdriveError.DC_BUS_OVER_CURRENT),
        (SUPPLY_RESISTANCE, "negative", -0.01, -1.0, OdriveError.DC_BUS_OVER_REGEN_CURRENT),
    ],
    ids=["a supply that takes no current back", "a limit on the current drawn",
         "a leg that brakes, and the limit as shipped"],
)  # fmt: skip
def test_beyond_the_bus_s_limits_both_axes_are_disarmed(
    resistance: float, setting: str, limit: float, torque: float, error: OdriveError
) -> None:
    bank = make_bank()
    bank.bus.resistance[2] = resistance
    bank.bus.changed()
    bank.settings.set(2, f"config.dc_max_{setting}_current", limit)
    bank.input_torque[4:6] = torque, 0.5
    step_for(bank, 0.03, vel=FAST)
    for axis in (4, 5):
        assert bank.heartbeat(axis)[:2] == (AxisError.MOTOR_FAILED, IDLE)
        assert bank.faults[axis].motor & MotorError.SYSTEM_LEVEL
        assert bank.faults[axis].odrive == error
    assert bank.state[6] == CLOSED_LOOP
