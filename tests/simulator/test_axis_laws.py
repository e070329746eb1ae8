"""Laws of the emulated axes against the firmware at its own rate, with and without encoders."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from numpy.typing import NDArray

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_encoders import PERIOD_S, OddEncoder, Words
from services.simulator.drives.axis_faults import FAULTS, AxisErrors
from shared.can.cansimple import (
    AxisError,
    AxisState,
    ControllerError,
    ControlMode,
    EncoderError,
    InputMode,
    MotorError,
)
from tests.simulator.banks import (
    CLOSED_LOOP,
    CPR,
    DRIVE,
    DT,
    IDLE,
    KT,
    ZERO,
    FirmwareAxis,
    close_loop,
    idle_bank,
    make_bank,
    step_for,
)

N = 12
SHARED = ("pos_gain", "vel_gain", "vel_integrator_gain", "vel_limit")
INPUTS = ("input_pos", "input_vel", "input_torque")
SWITCHES = ("enable_vel_limit", "enable_torque_mode_vel_limit")


class Motion:
    """Twelve shafts that swing: two sines each, peaks of about `speed` turn/s."""

    def __init__(self, rng: np.random.Generator, speed: float) -> None:
        self._w = 2.0 * math.pi * rng.uniform(0.5, 5.0, (2, N))
        self._a = 0.5 * speed * rng.uniform(0.2, 1.0, (2, N)) / self._w
        self._phase = rng.uniform(0.0, 2.0 * math.pi, (2, N))
        self._at = rng.uniform(-30.0, 30.0, N)

    def pos(self, t: float) -> NDArray[np.float64]:
        return np.asarray(self._at + (self._a * np.sin(self._w * t + self._phase)).sum(0))

    def vel(self, t: float) -> NDArray[np.float64]:
        return np.asarray((self._a * self._w * np.cos(self._w * t + self._phase)).sum(0))


def drawn(
    rng: np.random.Generator, motion: Motion, *, tight: bool
) -> tuple[AxisBank, list[FirmwareAxis]]:
    """Return a bank in closed loop and its twelve references, with the same random settings."""
    bank = AxisBank(DRIVE, encoder_counts_per_turn=CPR, watchdog=False)
    bank.settings.fill("config.dc_max_negative_current", -math.inf)
    bank.settings.fill("config.dc_bus_overvoltage_trip_level", math.inf)
    bank.settings.fill("config.dc_bus_undervoltage_trip_level", -math.inf)
    bank.settings.fill("controller.config.enable_overspeed_error", value=False)
    bank.step(0.0, motion.pos(0.0), motion.vel(0.0))
    axes = []
    for i in range(N):
        axis = FirmwareAxis(motion.pos(0.0)[i], motion.vel(0.0)[i], counts_per_turn=CPR)
        axis.control_mode = int(rng.integers(1, 4))
        axis.pos_gain, axis.vel_gain = rng.uniform(5.0, 40.0), rng.uniform(0.05, 0.6)
        axis.vel_integrator_gain = rng.choice([0.0, rng.uniform(0.1, 3.0)])
        axis.vel_integrator_limit = rng.choice([math.inf, 0.2])
        axis.vel_limit = rng.uniform(2.0, 12.0) if tight else 60.0
        axis.enable_vel_limit, axis.enable_torque_mode_vel_limit = rng.integers(0, 2, 2) > 0
        bank.current_lim[i] = rng.uniform(2.0, 12.0) if tight else 60.0
        axis.torque_lim = float(bank.current_lim[i]) * DRIVE.torque_constant
        bank.set_modes(i, axis.control_mode, InputMode.PASSTHROUGH)
        bank.request_state(i, AxisState.CLOSED_LOOP_CONTROL)
        below = f"axis{i & 1}.controller.config."
        for name in (*SWITCHES, "vel_integrator_limit"):
            bank.settings.set(i >> 1, below + name, getattr(axis, name))
        for name in SHARED:
            getattr(bank, name)[i] = getattr(axis, name)
        axes.append(axis)
    return bank, axes


def aim(rng: np.random.Generator, bank: AxisBank, axes: list[FirmwareAxis], speed: float) -> None:
    """Give both the same inputs, near where the shafts are, and now and then far beyond limits."""
    for i, axis in enumerate(axes):
        axis.input_pos = float(bank.pos_estimate[i]) + rng.normal(0.0, 0.02 * speed)
        axis.input_vel = rng.normal(0.0, speed)
        axis.input_torque = rng.normal(0.0, 1.0)
        for name in INPUTS:
            getattr(bank, name)[i] = getattr(axis, name)


@pytest.mark.parametrize("seed", range(20))
def test_at_one_estimate_the_bank_gives_the_firmwares_torque(seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = Motion(rng, speed=30.0)
    bank, axes = drawn(rng, motion, tight=bool(seed % 2))
    for _ in range(20):
        aim(rng, bank, axes, 30.0)
        torque = bank.step(0.0, ZERO, ZERO)
        expected = [
            axis.control(float(bank.pos_estimate[i]), float(bank.vel_estimate[i]))
            for i, axis in enumerate(axes)
        ]
        np.testing.assert_allclose(torque, expected, atol=1e-9)
        for axis in axes:  # the bank's stands still with its clock
            axis.integrator = 0.0


@pytest.mark.parametrize("tight", [False, True], ids=["free", "limited"])
@pytest.mark.parametrize(("speed", "bound"), [(0.0, 1e-6), (1.0, 0.02), (20.0, 0.06)])
def test_stepped_at_a_millisecond_the_torque_is_that_of_the_firmwares_own_rate(
    speed: float, bound: float, tight: bool
) -> None:
    """At the motor, N m: what is left is a sixteenth of a millisecond of the estimator's lag."""
    rng = np.random.default_rng(7)
    motion = Motion(rng, speed)
    bank, axes = drawn(rng, motion, tight=tight)
    worst, at_limit = 0.0, 0
    for k in range(1, 401):
        if k % 5 == 1:
            aim(rng, bank, axes, speed)
        torques = [0.0] * N
        for j in range(1, 9):
            pos = motion.pos((k - 1 + j / 8) * DT)
            for i, axis in enumerate(axes):
                axis.encoder(float(pos[i]))
                torques[i] = axis.control(axis.pos_estimate, axis.vel_estimate)
        torque = bank.step(k * DT, motion.pos(k * DT), motion.vel(k * DT))
        worst = max(worst, float(np.abs(torque - torques).max()))
        at_limit += sum(abs(t) == a.torque_lim for t, a in zip(torques, axes, strict=True))
    assert worst < bound
    assert not tight or at_limit > 200, "the limits were not reached"


@pytest.mark.parametrize("mode", [ControlMode.TORQUE, ControlMode.VELOCITY, ControlMode.POSITION])
@pytest.mark.parametrize("column", ["input_pos", "input_vel", "input_torque"])
def test_what_is_no_number_disarms_with_modulation_is_nan(mode: ControlMode, column: str) -> None:
    """The firmware's clamp passes NaN on; made the limit's torque, it would push a motor."""
    bank = make_bank()
    close_loop(bank, mode, range(2))
    bank.pos_gain[:], bank.vel_gain[:] = 20.0, 0.2
    getattr(bank, column)[0] = math.nan
    torque = bank.step(bank.now_s + 1e-3, ZERO, ZERO)
    used = {"input_torque": 1, "input_vel": 2, "input_pos": 3}[column] <= mode
    assert (bank.faults[0].motor == MotorError.MODULATION_IS_NAN) == used
    assert bank.faults[1].motor == 0
    assert np.isfinite(torque).all(), "nothing reaches the shaft, in IDLE neither"
    assert np.isfinite(bank.step(bank.now_s + 1e-3, ZERO, ZERO)).all()


@pytest.mark.parametrize(
    ("limit", "torque", "disarms"),
    [
        (math.nan, 80.0 * KT, False),
        (-1.0, 0.0, False),
        (-20.0, 0.0, True),
        (10.0, 10.0 * KT, False),
    ],
)
def test_a_current_limit_of_nan_limits_nothing_and_a_negative_one_leaves_no_torque(
    limit: float, torque: float, *, disarms: bool
) -> None:
    """Below the margin of -8 A even no current is too much (motor.cpp, 0.5.6)."""
    bank = make_bank()
    close_loop(bank, ControlMode.TORQUE, range(1))
    bank.current_lim[0], bank.input_torque[0] = limit, 80.0 * KT
    bank.step(bank.now_s + 1e-3, ZERO, ZERO)
    assert bank.step(bank.now_s + 1e-3, ZERO, ZERO)[0] == pytest.approx(torque)
    assert bank.faults[0] == (FAULTS["CURRENT_LIMIT"] if disarms else AxisErrors())


@pytest.mark.parametrize(("limit", "trips"), [(12.5, False), (11.5, True)])
def test_a_limit_that_is_lowered_below_the_flowing_current_less_its_margin_disarms(
    limit: float, *, trips: bool
) -> None:
    bank = make_bank()
    close_loop(bank, ControlMode.TORQUE, range(1))
    bank.input_torque[0] = 20.0 * KT
    for _ in range(50):
        bank.step(bank.now_s + 1e-3, ZERO, ZERO)
    bank.current_lim[0] = limit
    bank.step(bank.now_s + 1e-3, ZERO, ZERO)
    assert (bank.faults[0] == FAULTS["CURRENT_LIMIT"]) == trips


AXIS = 5
NEVER = 1e9


def turned(axis: int, turns: float) -> np.ndarray:
    """Return positions in which one axis alone is turned."""
    pos = ZERO.copy()
    pos[axis] = turns
    return pos


def read(bank: AxisBank, words: Words, axis: int = AXIS) -> None:
    bank.conditions.read_encoder(axis, words)


def quiet_bank(mode: ControlMode = ControlMode.TORQUE) -> AxisBank:
    """Return an armed bank that no speed disarms, nor what it regenerates."""
    bank = make_bank(mode)
    bank.settings.fill("config.dc_max_negative_current", -math.inf)
    bank.vel_limit[:] = NEVER
    return bank


@pytest.mark.parametrize("seed", range(8))
def test_words_that_come_and_go_count_as_in_the_firmware_cycle_by_cycle(seed: int) -> None:
    draw = random.Random(seed)
    vel = draw.uniform(-40.0, 40.0)
    axis = FirmwareAxis(7.3, vel, counts_per_turn=CPR)
    raw = math.floor(7.3 * CPR)
    odd = OddEncoder(raw, raw, raw, vel * CPR, per_turn=CPR, error_rate=0.0)
    counts = []
    for cycle in range(1, 2000):
        if draw.random() < 0.01:
            odd.words = draw.choice((*Words, Words.TRUE))
        raw = math.floor((7.3 + vel * cycle * PERIOD_S) * CPR)
        word = {Words.TRUE: raw % CPR, Words.NONE: None, Words.ZERO: 0}[odd.words]
        axis.com_fail = False
        axis.read(word)
        odd.run(PERIOD_S, raw, 1000.0)
        assert (odd.count, odd.angle) == (axis.shadow_count, axis.count_in_cpr)
        assert odd.fails == axis.com_fail
        assert odd.pos / CPR == pytest.approx(axis.pos_estimate, abs=1e-3)
        counts.append(odd.count)
    assert (counts[-1] - odd.angle) % CPR == 0, "a missing turn shows in neither"


@pytest.mark.parametrize("mode", [ControlMode.TORQUE, ControlMode.POSITION])
def test_a_gap_of_under_51_ms_is_held_through_without_an_error(mode: ControlMode) -> None:
    bank = quiet_bank(mode)
    step_for(bank, DT)
    read(bank, Words.NONE)
    step_for(bank, 0.050, turned(AXIS, 0.3))
    assert bank.state[AXIS] == CLOSED_LOOP
    assert bank.faults[AXIS] == AxisErrors()
    assert (bank.pos_estimate[AXIS], bank.vel_estimate[AXIS]) == (0.0, 0.0), "it freezes"
    read(bank, Words.TRUE)
    step_for(bank, 0.030, turned(AXIS, 0.3))
    assert bank.faults[AXIS] == AxisErrors()
    assert bank.pos_estimate[AXIS] == pytest.approx(0.3, abs=1e-3)


def test_from_51_ms_on_the_encoder_has_failed_and_the_axis_floats() -> None:
    bank = quiet_bank()
    bank.input_torque[:] = 1.0
    read(bank, Words.NONE)
    assert step_for(bank, 0.051)[AXIS] == 1.0, "armed and blind"
    torque = step_for(bank, DT)
    assert bank.state[AXIS] == IDLE
    assert bank.faults[AXIS].encoder == EncoderError.ABS_SPI_COM_FAIL
    assert bank.faults[AXIS].controller == ControllerError.INVALID_ESTIMATE
    assert bank.faults[AXIS].axis & AxisError.ENCODER_FAILED
    assert (torque[AXIS], torque[AXIS ^ 1]) == (0.0, 1.0)


def test_gaps_add_up_in_a_filter_of_a_second_that_clearing_errors_empties() -> None:
    together, apart = quiet_bank(), quiet_bank()
    for bank, between_s in ((together, 0.010), (apart, 3.0)):
        for _ in range(2):
            read(bank, Words.NONE)
            step_for(bank, 0.030)
            read(bank, Words.TRUE)
            step_for(bank, between_s)
    assert together.faults[AXIS].axis & AxisError.ENCODER_FAILED
    assert apart.faults[AXIS] == AxisErrors()
    bank = quiet_bank()
    read(bank, Words.NONE)
    step_for(bank, 0.1)
    bank.clear_errors(AXIS)
    bank.request_state(AXIS, CLOSED_LOOP)
    step_for(bank, 0.050)
    assert (bank.state[AXIS], bank.faults[AXIS]) == (CLOSED_LOOP, AxisErrors())
    step_for(bank, 0.002)
    assert bank.state[AXIS] == IDLE
    assert bank.faults[AXIS].axis & AxisError.ENCODER_FAILED


@pytest.mark.parametrize(
    ("moved", "found"), [(0.0, 0.0), (0.4, 0.4), (0.75, -0.25), (1.0, 0.0), (-3.1, -0.1)]
)
@pytest.mark.parametrize("gap_s", [0.045, 0.5])
def test_a_motor_that_turned_in_the_gap_is_found_by_the_nearest_way_turns_missing(
    moved: float, found: float, gap_s: float
) -> None:
    bank = quiet_bank()
    bank.set_count(AXIS, 64 * CPR)
    read(bank, Words.NONE)
    step_for(bank, gap_s, turned(AXIS, moved))
    read(bank, Words.TRUE)
    step_for(bank, 0.050, turned(AXIS, moved))
    assert bank.pos_estimate[AXIS] == pytest.approx(64.0 + found, abs=1e-3)
    assert bank.encoder_turns[AXIS] == pytest.approx(64.0 + found, abs=1e-3)
    own = math.floor(moved * CPR) + int(bank.encoder_mount[AXIS])
    assert bank.encoder_angle(AXIS) == own % CPR, "the angle is right all the same"
    assert not bank.faults[AXIS].controller, "an estimate that is valid again"
    step_for(bank, 0.1, turned(AXIS, moved), turned(AXIS, 1.0))
    assert bank.pos_estimate[AXIS] == pytest.approx(64.1 + found, abs=2e-3), "counted on"


def test_a_wrapped_count_is_overspeed_where_its_jump_makes_the_estimate_so_fast() -> None:
    """A step of d turns makes d w / e turn/s: at 1000 rad/s 0.25 turns are 92, the limit is 72."""
    for moved, disarms in ((0.1, False), (0.25, True), (0.75, True), (1.1, False)):
        bank = make_bank()
        read(bank, Words.NONE)
        step_for(bank, 0.045, turned(AXIS, moved))
        read(bank, Words.TRUE)
        step_for(bank, 0.02, turned(AXIS, moved))
        assert (bank.state[AXIS] == IDLE) == disarms, moved
        assert bank.faults[AXIS].controller == (ControllerError.OVERSPEED if disarms else 0)
        assert bank.faults[AXIS].encoder == 0


@pytest.mark.parametrize("turns", [0.1, 3.3, -2.4])
def test_an_encoder_that_reads_zero_freezes_at_its_nearest_turn_without_any_error(
    turns: float,
) -> None:
    bank = idle_bank(turned(AXIS, turns), mark=64.0, watchdog=False)
    step_for(bank, DT, turned(AXIS, turns))
    read(bank, Words.ZERO)
    step_for(bank, 1.0, turned(AXIS, turns), turned(AXIS, 0.5))
    own = turns + bank.encoder_mount[AXIS] / CPR
    at = 64.0 + turns - (own - round(own))
    assert bank.pos_estimate[AXIS] == pytest.approx(at, abs=1e-3)
    assert bank.encoder_angle(AXIS) == 0
    assert bank.faults[AXIS] == AxisErrors()
    bank.request_state(AXIS, CLOSED_LOOP)
    step_for(bank, 1.0, turned(AXIS, turns))
    assert bank.state[AXIS] == CLOSED_LOOP, "armed, and blind for as long as it likes"


def test_a_lost_encoder_in_idle_is_an_error_and_comes_back_where_it_was_set() -> None:
    bank = idle_bank(watchdog=False)
    bank.request_state(AXIS, CLOSED_LOOP)
    bank.request_state(AXIS, IDLE)
    for axis in (AXIS, 8):
        read(bank, Words.NONE, axis)
    step_for(bank, 0.06)
    assert bank.faults[8] == AxisErrors(
        AxisError.ENCODER_FAILED, encoder=EncoderError.ABS_SPI_COM_FAIL
    )
    assert bank.faults[AXIS].axis == AxisError.ENCODER_FAILED | AxisError.CONTROLLER_FAILED
    bank = idle_bank(mark=64.0)
    read(bank, Words.NONE, 2)
    step_for(bank, 0.1)
    assert bank.pos_estimate[2] == 64.0, "it reads what it did"
    bank.set_count(2, 0.0)
    read(bank, Words.TRUE, 2)
    step_for(bank, 0.03)
    assert bank.pos_estimate[2] == pytest.approx(0.0, abs=1e-3)
