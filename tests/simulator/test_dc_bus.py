"""The DC bus: current by power, and what braking legs trip."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.drives.axis_settings import PHASE_RESISTANCE
from services.simulator.drives.dc_bus import SUPPLY_RESISTANCE, SUPPLY_VOLTAGE
from shared.can.cansimple import AxisError, AxisState, MotorError, OdriveError
from tests.simulator.banks import DT, make_bank, step_for

KT = 0.0827
FAST = np.zeros(12)
FAST[4] = 20.0  # turn/s, axis0 of hip_right


def braking(torque: float) -> tuple[float, float]:
    """Return power and bus current of one axis at FAST, worked out from the equations."""
    mechanical = torque * 2.0 * math.pi * FAST[4]
    copper = 1.5 * PHASE_RESISTANCE * (torque / KT) ** 2
    power = mechanical + copper
    voltage = SUPPLY_VOLTAGE
    for _ in range(50):  # V = supply - R P / V, by repetition
        voltage = SUPPLY_VOLTAGE - SUPPLY_RESISTANCE * power / voltage
    return power, power / voltage


@pytest.mark.parametrize("torque", [1.0, -1.0, -3.0, 0.0])
def test_the_bus_current_is_that_of_mechanical_power_and_copper_losses(torque: float) -> None:
    bank = make_bank()
    bank.input_torque[4] = torque
    step_for(bank, 0.03, vel=FAST)
    _, current = braking(torque)
    voltage, got = bank.bus.state(2)
    assert got == pytest.approx(current, abs=0.05)
    assert voltage == pytest.approx(SUPPLY_VOLTAGE - SUPPLY_RESISTANCE * current, abs=0.01)
    assert bank.bus.state(3) == (SUPPLY_VOLTAGE, 0.0)


@pytest.mark.parametrize("resistor", [False, True], ids=["as configured", "with a brake resistor"])
def test_a_leg_may_brake(resistor: bool) -> None:
    bank = make_bank()
    if resistor:  # it takes what would be pushed back
        bank.settings.set(2, "config.dc_max_negative_current", -0.01)
        bank.settings.set(2, "config.enable_brake_resistor", value=True)
    bank.input_torque[4] = -1.0
    step_for(bank, 0.03, vel=FAST)
    assert bank.state[4] == AxisState.CLOSED_LOOP_CONTROL
    assert (bank.bus.state(2)[1] == pytest.approx(0.0, abs=1e-9)) == resistor


@pytest.mark.parametrize(
    ("resistance", "setting", "limit", "torque", "error"),
    [
        (10.0, "positive", math.inf, -1.0, OdriveError.DC_BUS_OVER_VOLTAGE),
        (SUPPLY_RESISTANCE, "positive", 5.0, 3.0, OdriveError.DC_BUS_OVER_CURRENT),
        (SUPPLY_RESISTANCE, "negative", -0.01, -1.0, OdriveError.DC_BUS_OVER_REGEN_CURRENT),
    ],
    ids=[
        "a supply that takes no current back",
        "a limit on the current drawn",
        "a leg that brakes, and the limit as shipped",
    ],
)
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
        assert bank.state[axis] == AxisState.IDLE
        assert bank.faults[axis].motor & MotorError.SYSTEM_LEVEL
        assert bank.faults[axis].odrive == error
        assert bank.heartbeat(axis).axis_error == AxisError.MOTOR_FAILED
    assert bank.state[6] == AxisState.CLOSED_LOOP_CONTROL


def test_a_sagging_supply_disarms_and_arms_again_only_when_it_is_back() -> None:
    bank = make_bank()
    bank.supply(2, 7.0)
    step_for(bank, DT)
    bank.clear_errors(4)
    step_for(bank, DT)
    assert bank.faults[4].odrive == OdriveError.DC_BUS_UNDER_VOLTAGE
    bank.supply(2, 48.0)
    bank.clear_errors(4)
    bank.request_state(4, AxisState.CLOSED_LOOP_CONTROL)
    step_for(bank, DT)
    assert bank.state[4] == AxisState.CLOSED_LOOP_CONTROL
    assert bank.is_responding(4), "it has not been off"
