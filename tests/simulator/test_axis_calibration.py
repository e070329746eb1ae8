"""Calibration: what it takes, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_calibration import ENCODER_S, MOTOR_S
from shared.can.cansimple import AxisError, AxisState, EncoderError, MotorError
from tests.simulator.banks import DT, make_bank, step_for


def uncalibrated() -> AxisBank:
    """Return a bank whose axis 2 has not been calibrated."""
    bank = make_bank()
    for name in ("motor", "encoder"):
        bank.settings.set(1, f"axis0.{name}.config.pre_calibrated", value=False)
    bank.settings.save(1)
    bank.reboot(2)
    step_for(bank, 1.6)
    assert bank.state[2] == AxisState.IDLE
    return bank


@pytest.mark.parametrize(
    "state",
    [AxisState.CLOSED_LOOP_CONTROL, AxisState.ENCODER_OFFSET_CALIBRATION],
    ids=["closed loop", "the encoder's calibration before the motor's"],
)
def test_an_uncalibrated_axis_refuses_a_state_as_invalid_and_its_sibling_does_not(
    state: AxisState,
) -> None:
    bank = uncalibrated()
    bank.request_state(2, state)
    assert bank.state[2] == AxisState.IDLE
    assert bank.faults[2].axis == AxisError.INVALID_STATE
    bank.request_state(3, state)
    assert bank.state[3] == state


def test_the_full_sequence_takes_its_time_and_then_closed_loop_is_granted() -> None:
    bank = uncalibrated()
    bank.request_state(2, AxisState.FULL_CALIBRATION_SEQUENCE)
    step_for(bank, 0.5 * MOTOR_S)
    assert bank.state[2] == AxisState.MOTOR_CALIBRATION
    step_for(bank, 0.5 * MOTOR_S + 2 * DT)
    assert bank.state[2] == AxisState.ENCODER_OFFSET_CALIBRATION
    step_for(bank, ENCODER_S)
    assert bank.state[2] == AxisState.IDLE
    bank.request_state(2, AxisState.CLOSED_LOOP_CONTROL)
    assert bank.state[2] == AxisState.CLOSED_LOOP_CONTROL


def test_under_a_load_the_encoders_calibration_fails_and_leaves_the_axis_uncalibrated() -> None:
    bank = uncalibrated()
    bank.request_state(2, AxisState.MOTOR_CALIBRATION)
    step_for(bank, MOTOR_S + DT)
    bank.request_state(2, AxisState.ENCODER_OFFSET_CALIBRATION)
    sinking = np.zeros(12)
    sinking[2] = 0.1
    step_for(bank, 1.0, vel=sinking)
    assert bank.faults[2].encoder == EncoderError.CPR_POLEPAIRS_MISMATCH
    bank.clear_errors(2)
    bank.request_state(2, AxisState.CLOSED_LOOP_CONTROL)
    step_for(bank, 2 * DT)
    assert bank.state[2] == AxisState.IDLE
    assert bank.faults[2].motor == MotorError.UNKNOWN_PHASE_ESTIMATE, "and no INVALID_STATE"


def test_another_request_breaks_a_calibration_off() -> None:
    bank = uncalibrated()
    bank.request_state(2, AxisState.MOTOR_CALIBRATION)
    bank.request_state(2, AxisState.IDLE)
    step_for(bank, MOTOR_S + DT)
    assert not bank.calibration.motor[2]


def test_an_axis_that_calibrates_makes_no_torque() -> None:
    bank = make_bank()
    bank.input_torque[2] = 1.0
    bank.request_state(2, AxisState.MOTOR_CALIBRATION)
    assert step_for(bank, DT)[2] == 0.0
