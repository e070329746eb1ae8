"""Encoders that send no words, or zeros: what the firmware makes of them, and without an error."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_faults import AxisErrors
from services.simulator.drives.odd_encoder import PERIOD_S, OddEncoder, Words
from shared.can.cansimple import AxisError, ControllerError, ControlMode, EncoderError
from tests.simulator.banks import CLOSED_LOOP, CPR, DT, IDLE, ZERO, idle_bank, make_bank, step_for
from tests.simulator.firmware import FirmwareAxis

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


def test_clearing_errors_empties_the_filter_so_that_a_lost_encoder_is_armed_again_for_51_ms() -> (
    None
):
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


def test_gaps_add_up_in_a_filter_of_a_second() -> None:
    together, apart = quiet_bank(), quiet_bank()
    for bank, between_s in ((together, 0.010), (apart, 3.0)):
        for _ in range(2):
            read(bank, Words.NONE)
            step_for(bank, 0.030)
            read(bank, Words.TRUE)
            step_for(bank, between_s)
    assert together.faults[AXIS].axis & AxisError.ENCODER_FAILED
    assert apart.faults[AXIS] == AxisErrors()


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


def test_a_lost_encoder_in_idle_says_so_and_its_controller_only_once_it_has_been_armed() -> None:
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


def test_a_lost_encoder_comes_back_where_it_was_set_since() -> None:
    bank = idle_bank(mark=64.0)
    read(bank, Words.NONE, 2)
    step_for(bank, 0.1)
    assert bank.pos_estimate[2] == 64.0, "it reads what it did"
    bank.set_count(2, 0.0)
    read(bank, Words.TRUE, 2)
    step_for(bank, 0.03)
    assert bank.pos_estimate[2] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("words", [Words.NONE, Words.ZERO])
def test_a_drive_that_starts_without_its_encoder_counts_from_zero(words: Words) -> None:
    bank = idle_bank(np.full(12, 0.2), mark=64.0)
    read(bank, words, 4)
    bank.reboot(4)
    step_for(bank, 0.02, np.full(12, 0.2))
    assert bank.pos_estimate[4] == 0.0
    read(bank, Words.TRUE, 4)
    step_for(bank, 0.1, np.full(12, 0.2))
    own = 0.2 + bank.encoder_mount[4] / CPR
    assert bank.pos_estimate[4] == pytest.approx(own - round(own), abs=1e-3)


def test_a_rotor_away_from_its_last_word_is_driven_off_phase() -> None:
    """Seven pole pairs: a quarter of an electrical turn, 1/28 turn, and the torque is none."""
    bank = quiet_bank()
    bank.input_torque[:] = 1.0
    read(bank, Words.NONE)
    for moved, share in ((1 / 56, math.sqrt(0.5)), (1 / 28, 0.0), (1 / 14, -1.0), (1 / 7, 1.0)):
        torque = step_for(bank, DT, turned(AXIS, moved))
        assert torque[AXIS] == pytest.approx(share, abs=0.01)
        assert torque[AXIS ^ 1] == 1.0
