"""What bring-up needs of an ODrive: settings by name, read and written; no matter over what."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from enum import IntFlag
from typing import Final, NamedTuple, Protocol

from shared.can.cansimple import AxisError, ControllerError, EncoderError, MotorError
from shared.can.drive_settings import AXES
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError

Value = bool | int | float | str | None
"""A value of any endpoint; text: the name of another endpoint, or none at all."""

FIRMWARE: Final = (0, 5, 6)
"""Firmware that the settings' names and the drivers are made for."""
OLDEST: Final = (0, 5, 4)
"""Before it, the CAN settings, the board's error register and the heartbeat are other ones."""

AXIS_ERRORS: Final[dict[str, type[IntFlag]]] = {
    "error": AxisError, "motor.error": MotorError, "encoder.error": EncoderError,
    "controller.error": ControllerError,
}  # fmt: skip
"""An axis's error registers; any may be set while the others are 0."""
_AXIS_STATUS: Final = (
    *AXIS_ERRORS,
    "current_state",
    "motor.fet_thermistor.temperature",
    "motor.is_calibrated",
    "encoder.is_ready",
    "encoder.pos_estimate",
)
STATUS: Final = (
    "error",
    "vbus_voltage",
    "brake_resistor_armed",
    *(f"{axis}.{name}" for axis in AXES for name in _AXIS_STATUS),
)
"""A board's state, besides its settings."""


class Board(Protocol):
    """One ODrive. Every method may take seconds, and fails with one clear sentence.

    Raises:
        DriveError: from every method: the board does not answer any more, or not in time.
    """

    @property
    def serial_number(self) -> str:
        """12 hexadecimal digits."""

    @property
    def firmware(self) -> tuple[int, int, int]:
        """As 0, 5, 6."""

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of all settings that this board saves."""

    def read(self, names: Iterable[str]) -> dict[str, Value]:
        """Return the values of these endpoints; those that the board does not have are left out."""

    def write(self, values: Mapping[str, Value]) -> None:
        """Write these endpoints in order; they are lost at the next restart unless saved."""

    def save(self) -> None:
        """Save the configuration, which restarts the board, and wait until it is back."""

    def restart(self) -> None:
        """Restart the board without saving, and wait until it is back: settings as saved."""

    def clear_errors(self) -> None:
        """Clear the errors of both axes."""

    def states(self) -> tuple[int, int]:
        """Return `AxisState` of both axes."""


class FoundBoards(NamedTuple):
    """The boards on one way of access."""

    boards: dict[str, Board]
    """By serial number; the requested ones that answered."""
    troubles: dict[str, str]
    """By serial number: why a requested one is missing."""
    strangers: tuple[str, ...]
    """Serial numbers found that were not requested."""

    def in_no_module(self, robot: RobotConfig) -> str:
        """Return what to say of the strangers that are no module's of the robot; "": none is."""
        known = {module.serial_number.upper() for module in robot.module}
        strangers = ", ".join(serial for serial in self.strangers if serial not in known)
        return f"; plugged in and in no [[module]]: {strangers}" if strangers else ""


def equal(one: Value, other: Value) -> bool:
    """Return True if two values are the same to a board, which keeps single floats."""
    if isinstance(one, float) and isinstance(other, int | float):
        if math.isnan(one) and math.isnan(other):
            return True
        return math.isclose(one, other, rel_tol=1e-6)
    if isinstance(other, float) and isinstance(one, int):
        return equal(other, one)
    return one == other


def is_known(firmware: tuple[int, int, int]) -> bool:
    """Return True for a firmware whose settings have the names that are used here."""
    return firmware >= OLDEST and firmware[:2] == FIRMWARE[:2]


def describe_firmware(firmware: tuple[int, int, int]) -> str:
    """Return "0.5.6"."""
    return ".".join(map(str, firmware))


def number(values: Mapping[str, Value], name: str) -> float:
    """Return a value that must be a number."""
    value = values.get(name)
    if not isinstance(value, int | float):
        raise DriveError(f"no number at {name}; is this an ODrive v3 with firmware 0.5.x?")
    return value
