"""A board without a wire: what is written counts once it is saved, as on a real one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import msgspec

from shared.can.drive_settings import AXES, of_module
from shared.config.files import load_without_schedule
from shared.config.robot_config import RobotConfig
from tests.conftest import ROBOT_FILE
from tools.bringup.boards import Value

READINGS: dict[str, Value] = {
    "error": 0,
    "vbus_voltage": 48.0,
    "config.dc_bus_undervoltage_trip_level": 8.0,
}
AXIS_READINGS: dict[str, Value] = {
    "error": 0,
    "motor.error": 0,
    "encoder.error": 0,
    "controller.error": 0,
    "current_state": 1,
    "motor.is_calibrated": True,
    "encoder.is_ready": True,
    "encoder.pos_estimate": 64.0,
}


def healthy() -> dict[str, Value]:
    """Return the readings of a board that nothing is wrong with."""
    axes = {f"{axis}.{name}": value for axis in AXES for name, value in AXIS_READINGS.items()}
    return READINGS | axes


class BoardInMemory:
    """Implements `tools.bringup.boards.Board`.

    Attributes:
        deaf: settings that keep their value whatever is written.
        writes: what was written, in order.
        saves: how often it was saved.
    """

    def __init__(self, settings: Mapping[str, Value], **readings: Value) -> None:
        self.serial_number = "3A0000000005"
        self.firmware = (0, 5, 6)
        self.kept = dict(settings)
        self.now = dict(settings)
        self.readings = healthy() | readings
        self.deaf: set[str] = set()
        self.writes: list[str] = []
        self.saves = 0

    @property
    def settings(self) -> tuple[str, ...]:
        return tuple(self.now)

    def read(self, names: Iterable[str]) -> dict[str, Value]:
        values = self.readings | self.now
        return {name: values[name] for name in names if name in values}

    def write(self, values: Mapping[str, Value]) -> None:
        self.writes += values
        self.now |= {name: value for name, value in values.items() if name not in self.deaf}

    def save(self) -> None:
        self.saves += 1
        self.kept = dict(self.now)

    def restart(self) -> None:
        self.now = dict(self.kept)

    def clear_errors(self) -> None:
        self.readings |= {name: 0 for name in self.readings if name.endswith("error")}

    def states(self) -> tuple[int, int]:
        first, second = (self.readings[f"{axis}.current_state"] for axis in AXES)
        assert isinstance(first, int)
        assert isinstance(second, int)
        return first, second


def with_driver(robot: RobotConfig, driver: str) -> RobotConfig:
    """Return a robot whose joint services have another driver."""
    service = msgspec.structs.replace(robot.joint_service, driver=driver)
    return msgspec.structs.replace(robot, joint_service=service)


def as_wanted() -> dict[str, Value]:
    """Return what the shipped robot wants of knee_left."""
    return {
        row.name: row.value for row in of_module(load_without_schedule(ROBOT_FILE), "knee_left")
    }
