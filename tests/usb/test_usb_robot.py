"""A robot file with drives on USB, and the fleet that is planned for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError
from shared.places import DEFAULT_CONFIG
from tests.usb import robot_file
from tools.fleet import process_table


def plan(path: Path, *, simulation: bool) -> process_table.FleetPlan:
    options = process_table.FleetOptions(simulation=simulation)
    return process_table.make_plan(path, Path("/tmp/xrl-t"), options)


@pytest.mark.parametrize("driver", ["odrive_can", "odrive_usb"])
@pytest.mark.parametrize(
    ("serial", "words"),
    [("3A00000001", "12 hexadecimal digits"), ("3A0000000002", "each drive once")],
)
def test_a_wrong_serial_number_is_refused_whichever_the_driver(
    tmp_path: Path, driver: str, serial: str, words: str
) -> None:
    path = robot_file.write(tmp_path)
    text = path.read_text().replace("odrive_usb", driver, 1).replace("3A0000000001", serial)
    path.write_text(text)
    with pytest.raises(ConfigError, match=words):
        config_file.load(path)


def test_a_serial_number_may_be_missing_only_without_usb_and_only_emulated_usb_has_the_stand_in(
    tmp_path: Path, robot: RobotConfig
) -> None:
    path = robot_file.write(tmp_path)
    path.write_text(path.read_text().replace('serial_number = "3A0000000004"\n', ""))
    with pytest.raises(ConfigError, match="ankle_left"):
        config_file.load(path)
    path.write_text(path.read_text().replace('"odrive_usb"', '"odrive_can"', 1))
    assert config_file.load(path).module_named("ankle_left").serial_number == ""
    path = robot_file.write(tmp_path)
    path = robot_file.write(tmp_path)
    assert plan(path, simulation=True).emulated_usb
    assert not plan(path, simulation=False).emulated_usb
    assert not plan(DEFAULT_CONFIG, simulation=True).emulated_usb
    assert len({module.serial_number for module in robot.module}) == 6
