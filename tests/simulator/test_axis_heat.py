"""Heat of the emulated axes, and what the firmware makes of it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.drives.axis_heat import Heat
from shared.can.cansimple import AxisState, ControlMode, MotorError
from tests.simulator.banks import DT, ZERO, close_loop, idle_bank, make_bank, step_for

HALF = 0.5 * 60.0 * 0.0827


def loaded_bank(heat: Heat | None = None) -> AxisBank:
    """Return an armed bank, asked for more torque than there is."""
    bank = idle_bank(watchdog=False, heat=heat)
    close_loop(bank, ControlMode.TORQUE)
    bank.vel_gain[:] = 10.0  # else the velocity limit of torque mode clamps first
    bank.input_torque[:] = 99.0
    return bank


def test_a_stage_near_its_limit_has_less_current() -> None:
    bank = loaded_bank()
    bank.heat.force(3, 110.0)  # halfway from 100 to 120
    torque = step_for(bank, 1.5)
    assert torque[3] == pytest.approx(HALF, rel=0.01)
    assert torque[2] == pytest.approx(60.0 * 0.0827)


def test_a_stage_heated_at_once_derates_and_disarms_half_a_second_later() -> None:
    bank = loaded_bank()
    bank.heat.force(3, 130.0)
    torques = {}
    for k in range(1, 700):
        torques[k] = float(bank.step(k * DT, ZERO, ZERO)[3])
        if bank.state[3] is not AxisState.CLOSED_LOOP_CONTROL:
            break
    x = 0.478  # both low-passes: 1 - (1 + t / tau) exp(-t / tau) = 100 / 105
    assert 1.0 - (1.0 + x / 0.1) * math.exp(-x / 0.1) == pytest.approx(100.0 / 105.0, abs=2e-3)
    assert k * DT == pytest.approx(x, abs=0.02)
    half = next(t for t, torque in torques.items() if torque < HALF)
    assert half * DT == pytest.approx(0.33, abs=0.03), "it derates before it disarms"
    assert torques[k - 1] == 0.0
    assert bank.faults[3].motor == MotorError.FET_THERMISTOR_OVER_TEMP
    assert bank.state[2] is AxisState.CLOSED_LOOP_CONTROL


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


def test_temperatures_end_where_loss_and_resistances_say_and_heat_is_conserved() -> None:
    heat = Heat()
    bank = make_bank()
    square = np.full(12, (20.0 * 0.0827) ** 2)
    bank.heat.skip(square, 36_000.0)
    rise = heat.winding_to_housing + heat.housing_to_air
    winding = float(bank.heat.winding[0])
    loss = 1.5 * heat.resistance * (1.0 + 0.00393 * (winding - 25.0)) * 400.0
    assert winding == pytest.approx(heat.ambient + rise * loss, abs=0.1)
    assert bank.heat.housing[0] == pytest.approx(heat.ambient + heat.housing_to_air * loss, abs=0.1)
    assert bank.heat.fet[0] == pytest.approx(25.0 + 0.054 * 400.0, abs=0.01)


def test_skipped_time_is_what_the_same_time_under_the_same_torque_is() -> None:
    stepped, skipped = loaded_bank(), loaded_bank()
    stepped.current_lim[:] = skipped.current_lim[:] = 20.0
    step_for(stepped, 20.0)
    skipped.heat.skip(np.full(12, (20.0 * 0.0827) ** 2), 20.0)
    assert stepped.heat.numbers() == pytest.approx(skipped.heat.numbers(), abs=0.2)


def test_a_warm_winding_draws_more_power_for_the_same_torque() -> None:
    cold, warm = (loaded_bank(Heat(warm=warm)) for warm in (0.0, 60.0))
    for bank in (cold, warm):
        bank.input_torque[:] = 1.0
        step_for(bank, 0.05)
    ratio = warm.bus.powers(0)[0] / cold.bus.powers(0)[0]
    assert ratio == pytest.approx(1.0 + 60.0 * 0.00393, rel=1e-3)
