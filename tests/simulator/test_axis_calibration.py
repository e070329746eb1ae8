"""Calibration: how long it takes, what it finds, and what it leaves behind when it fails.

Each motor has a rotor of its own here, free, loaded or blocked; the field has to turn it.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.drives.axis_calibration import INDUCTANCE_S, LOCK_S, RESISTANCE_S
from services.simulator.drives.axis_faults import AxisErrors
from services.simulator.drives.axis_settings import PHASE_INDUCTANCE, PHASE_RESISTANCE, POLE_PAIRS
from shared.can.cansimple import AxisError, AxisState, ControlMode, EncoderError, MotorError
from tests.simulator.banks import CPR, DT, FreeRotors, make_bank

MOTOR_S = RESISTANCE_S + INDUCTANCE_S
ENCODER_S = LOCK_S + 8.0
"""At 4 pi rad/s, 16 pi out and 16 pi back."""
AT = 64.28
"""turns; a zero of 64 turns and a joint that is not quite there."""
MOTOR, ENCODER = AxisState.MOTOR_CALIBRATION, AxisState.ENCODER_OFFSET_CALIBRATION
FULL = AxisState.FULL_CALIBRATION_SEQUENCE


class Rotor:
    """Axis 2, uncalibrated, on a rotor of its own."""

    def __init__(self, **settings: float) -> None:
        self.bank = bank = make_bank(ControlMode.POSITION)
        bank.encoder_mount[2] = 0.0
        for name in ("motor.config.pre_calibrated", "encoder.config.pre_calibrated"):
            bank.settings.set(1, f"axis0.{name}", value=False)
        bank.settings.set(1, "axis0.encoder.config.direction", 0)
        for name, value in settings.items():
            bank.settings.set(1, f"axis0.{name.replace('__', '.config.')}", value)
        bank.settings.save(1)
        bank.reboot(2)
        for axis in {*range(12)} - {2}:
            bank.request_state(axis, AxisState.IDLE)
        self.rotors = FreeRotors(bank, np.full(12, AT - 64.0))
        self.wait(1.6)
        self.run(0.02)
        assert bank.state[2] == AxisState.IDLE
        bank.set_count(2, round(AT * CPR))

    def run(self, seconds: float) -> None:
        self.rotors.run(seconds)

    def wait(self, seconds: float) -> None:
        """Let time pass in one step, in which no rotor turns."""
        self.bank.step(self.bank.now_s + seconds, self.rotors.pos, np.zeros(12))

    def pass_motor(self) -> None:
        """Wait until the motor's part of the full sequence is over."""
        self.wait(RESISTANCE_S)
        self.wait(INDUCTANCE_S)

    def ask(self, state: AxisState) -> None:
        self.bank.request_state(2, state)

    def found(self, name: str) -> float:
        return float(self.bank.settings.axis(name)[2])

    @property
    def calibrated(self) -> tuple[bool, bool]:
        return self.bank.calibration.motor[2], self.bank.calibration.encoder[2]


def test_the_full_sequence_takes_its_time_turns_the_shaft_out_and_back_and_finds_what_is() -> None:
    rotor = Rotor()
    rotor.ask(FULL)
    rotor.run(MOTOR_S - 0.01)
    assert rotor.bank.state[2] == MOTOR
    assert rotor.bank.encoder_turns[2] == pytest.approx(AT, abs=0.5 / POLE_PAIRS)
    rotor.run(0.02)
    assert rotor.bank.state[2] == ENCODER
    rotor.run(ENCODER_S - 0.02)
    assert rotor.bank.state[2] == ENCODER
    rotor.run(0.03)
    assert (rotor.bank.state[2], rotor.bank.faults[2]) == (AxisState.IDLE, AxisErrors())
    assert rotor.calibrated == (True, True)
    assert rotor.rotors.farthest[2] == pytest.approx(8.0 / POLE_PAIRS, abs=0.5 / POLE_PAIRS)
    assert rotor.found("motor.config.phase_resistance") == pytest.approx(PHASE_RESISTANCE)
    assert rotor.found("motor.config.phase_inductance") == PHASE_INDUCTANCE
    assert rotor.found("encoder.config.direction") == 1.0
    poles = rotor.found("encoder.config.phase_offset") / CPR * POLE_PAIRS
    assert poles == pytest.approx(round(poles), abs=0.1), "the field's zero is at one of the poles"
    rotor.ask(AxisState.CLOSED_LOOP_CONTROL)
    assert rotor.bank.state[2] == AxisState.CLOSED_LOOP_CONTROL


def test_an_encoder_calibrates_after_its_motor_and_forgets_its_turns_as_it_begins() -> None:
    rotor = Rotor()
    rotor.ask(ENCODER)
    assert rotor.bank.faults[2].axis == AxisError.INVALID_STATE
    assert rotor.bank.encoder_turns[2] == pytest.approx(AT, abs=1e-3)
    rotor.bank.request_state(3, ENCODER)
    assert rotor.bank.state[3] == ENCODER, "its sibling's motor is calibrated"
    rotor = Rotor()
    rotor.bank.calibration.motor[2] = True
    rotor.ask(ENCODER)
    assert rotor.bank.encoder_turns[2] == pytest.approx(0.28, abs=1e-3)
    rotor.run(DT)
    assert rotor.bank.pos_estimate[2] == pytest.approx(0.28, abs=1e-2)
    assert abs(rotor.bank.vel_estimate[2]) < 0.1, "and its rate knows nothing of it"


VIOLATION = AxisErrors(AxisError.MOTOR_FAILED, motor=MotorError.CURRENT_LIMIT_VIOLATION)
RESISTANCE = AxisErrors(AxisError.MOTOR_FAILED, motor=MotorError.PHASE_RESISTANCE_OUT_OF_RANGE)
MISMATCH = AxisErrors(AxisError.ENCODER_FAILED, encoder=EncoderError.CPR_POLEPAIRS_MISMATCH)
NO_RESPONSE = AxisErrors(AxisError.ENCODER_FAILED, encoder=EncoderError.NO_RESPONSE)


@pytest.mark.parametrize(
    ("settings", "load", "blocked", "fault", "within_s"),
    [
        ({"motor__calibration_current": 30.0}, 0.0, False, RESISTANCE, 0.2),
        ({"motor__resistance_calib_max_voltage": 0.9}, 0.0, False, RESISTANCE, 0.3),
        ({"motor__calibration_current": 19.0, "motor__current_lim": 10.0}, 0.0, False,
         VIOLATION, 0.4),
        ({"motor__pole_pairs": 14}, 0.0, False, MISMATCH, 5.1),
        ({"motor__pole_pairs": 8}, 0.0, False, MISMATCH, 5.1),
        ({"encoder__cpr": CPR // 2}, 0.0, False, MISMATCH, 5.1),
        ({}, 0.0, True, NO_RESPONSE, 5.1),
        ({}, 2.0, False, MISMATCH, 5.1),
    ],
    ids=["more current than volts", "few volts", "beyond the current limit", "twice the poles",
         "one pole pair more", "half the counts", "blocked", "loaded"],
)  # fmt: skip
def test_a_calibration_that_fails_says_why_stops_there_and_leaves_the_axis_uncalibrated(
    settings: dict[str, float], load: float, blocked: bool, fault: AxisErrors, within_s: float
) -> None:
    rotor = Rotor(**settings)
    rotor.rotors.load[2] = load
    rotor.rotors.blocked = {2} if blocked else set()
    rotor.ask(FULL)
    if fault.encoder:
        rotor.pass_motor()
    rotor.run(within_s)
    assert (rotor.bank.state[2], rotor.bank.faults[2]) == (AxisState.IDLE, fault)
    assert rotor.calibrated == (bool(fault.encoder), False)
    assert math.isnan(rotor.found("motor.config.phase_resistance")) == (fault == RESISTANCE)
    rotor.run(0.5)
    assert rotor.bank.torque[2] == 0.0
