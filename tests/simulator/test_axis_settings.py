"""The drives' settings: the firmware's names, its defaults, and what the robot wants."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.simulator.drives.axis_settings import NAMES, Settings, configured
from shared.can.cansimple import AxisState
from shared.exceptions import DriveError
from tests.simulator.banks import CPR, DRIVE, DT, make_bank, step_for


def test_a_value_set_by_name_is_that_drives_alone_and_of_its_own_type() -> None:
    settings = Settings()
    settings.set(2, "axis1.controller.config.vel_limit", 7)
    settings.set(2, "axis1.config.enable_watchdog", 1)
    assert settings.get(2, "axis1.controller.config.vel_limit") == 7.0
    assert settings.get(2, "axis1.config.enable_watchdog") is True
    assert settings.get(2, "axis0.controller.config.vel_limit") == 2.0
    assert settings.get(1, "axis1.controller.config.vel_limit") == 2.0
    assert settings.axis("controller.config.vel_limit")[5] == 7.0


def test_the_table_has_every_name_in_the_type_of_its_default() -> None:
    table = configured(DRIVE, encoder_counts_per_turn=CPR).table(0)
    assert tuple(table) == NAMES
    assert isinstance(table["axis0.motor.config.pole_pairs"], int)
    assert isinstance(table["axis0.motor.config.pre_calibrated"], bool)
    assert isinstance(table["config.brake_resistance"], float)
    assert math.isinf(float(table["config.dc_max_positive_current"]))


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("axis0.controller.config.vel_limits", 1.0, "axis0.controller.config.vel_limit"),
        ("axis2.controller.config.vel_limit", 1.0, "the nearest is"),
        ("axis0.motor.config.pole_pairs", 7.5, "int"),
        ("axis0.controller.config.vel_gain", math.nan, "float"),
    ],
)
def test_a_wrong_name_or_value_is_refused_with_what_would_be_right(
    name: str, value: float, says: str
) -> None:
    with pytest.raises(DriveError, match=says):
        Settings().set(0, name, value)


@pytest.mark.parametrize(("direction", "sign"), [(1, 1.0), (-1, -1.0), (0, 1.0)])
def test_a_current_has_the_sign_of_the_phases_and_the_motor_none_of_it(
    direction: int, sign: float
) -> None:
    """Motor::update turns the torque round, and the phases turn it back."""
    bank = make_bank()
    bank.settings.set(0, "axis1.encoder.config.direction", direction)
    bank.input_torque[:2] = 0.0827
    torque = step_for(bank, DT)
    assert torque[:2] == pytest.approx([0.0827, 0.0827])
    currents = [bank.settings.current(axis, torque[axis]) for axis in (0, 1)]
    assert currents == pytest.approx([1.0, sign])


def test_a_restart_brings_back_what_was_saved() -> None:
    bank = make_bank()
    bank.settings.set(1, "axis0.controller.config.vel_limit", 5.0)
    bank.settings.save(1)
    bank.settings.set(1, "axis0.controller.config.vel_limit", 9.0)
    bank.settings.set(1, "axis1.motor.config.current_lim", 1.0)
    bank.reboot(2)
    assert bank.vel_limit[2] == 5.0
    assert bank.current_lim[3] == 60.0


def test_the_bank_acts_on_a_setting_from_the_next_step_on() -> None:
    bank = make_bank(watchdog=False)
    bank.input_torque[:] = 2.0
    bank.settings.set(0, "axis1.motor.config.current_lim", 10.0)
    torque = step_for(bank, DT)
    assert torque[1] == pytest.approx(10.0 * 0.0827)
    assert torque[0] == 2.0
    bank.settings.set(0, "axis0.config.enable_watchdog", value=True)
    step_for(bank, 0.12)
    assert bank.state[0] == AxisState.IDLE
    assert bank.state[1] == AxisState.CLOSED_LOOP_CONTROL


def test_a_wrong_cpr_scales_the_position() -> None:
    bank = make_bank()
    bank.settings.set(0, "axis0.encoder.config.cpr", CPR // 2)
    step_for(bank, 0.1, pos=np.full(12, 0.5))
    assert bank.pos_estimate[0] == pytest.approx(1.0, abs=1e-3)
    assert bank.pos_estimate[1] == pytest.approx(0.5, abs=1e-3)
