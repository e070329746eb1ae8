"""Back up, compare, write and read back the settings of ODrives, by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import IntFlag
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple, Protocol

import msgspec
from rich import box
from rich.console import Group
from rich.padding import Padding
from rich.table import Column, Table
from rich.text import Text

from shared.atomic_file import atomic_file
from shared.can.cansimple import AxisError, AxisState, ControllerError, EncoderError, MotorError
from shared.can.drive_settings import AXES, WantedSetting, describe_value
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.toml_file import read_text

Value = bool | int | float | str | None
"""Value of an endpoint. A string is the name of another endpoint; None means no endpoint."""

FIRMWARE: Final = (0, 5, 6)
"""Firmware for which the drivers and the names of the settings are written."""
OLDEST: Final = (0, 5, 4)
"""Oldest supported firmware; older ones differ in CAN settings, board errors and heartbeat."""

AXIS_ERRORS: Final[dict[str, type[IntFlag]]] = {
    "error": AxisError, "motor.error": MotorError, "encoder.error": EncoderError,
    "controller.error": ControllerError,
}  # fmt: skip
"""Error registers of an axis; one may be set while the others are 0."""
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
"""Endpoints that describe the state of a board."""

ABSOLUTE: Final = 0x100
"""Bit of `encoder.config.mode` that marks an absolute encoder."""
DIRECTION: Final = "encoder.config.direction"
_NOT_JSON: Final = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
"""Numbers that JSON cannot represent, by their text in the file."""

CALIBRATE: Final = "hang the leg and run `xrl drive configure --apply --calibrate`"
_CALIBRATED = {"motor.config.pre_calibrated": "motor.is_calibrated",
               "encoder.config.pre_calibrated": "encoder.is_ready"}  # fmt: skip
"""Settings that a drive accepts only after calibration, and the endpoints that report it."""
_FOUND = (DIRECTION, "encoder.config.phase_offset", "encoder.config.phase_offset_float")
"""Results of the encoder calibration for the present wiring. With other values the motor has no
torque, or runs away.
"""


class Board(Protocol):
    """One ODrive. Every method may take seconds.

    Raises:
        DriveError: from every method, if the board does not answer in time.
    """

    @property
    def serial_number(self) -> str:
        """12 hexadecimal digits."""

    @property
    def firmware(self) -> tuple[int, int, int]:
        """Version, such as (0, 5, 6)."""

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of all settings that this board saves."""

    def read(self, names: Iterable[str]) -> dict[str, Value]:
        """Return the values of endpoints, except those that the board lacks."""

    def write(self, values: Mapping[str, Value]) -> None:
        """Write endpoints in order; the next restart discards values that were not saved."""

    def save(self) -> None:
        """Save the configuration, which restarts the board, and wait until it reconnects."""

    def restart(self) -> None:
        """Restart the board with its saved settings, and wait until it reconnects."""

    def clear_errors(self) -> None:
        """Clear the errors of both axes."""

    def states(self) -> tuple[int, int]:
        """Return `AxisState` of both axes."""


class FoundBoards(NamedTuple):
    """Result of a search for boards."""

    boards: dict[str, Board]
    """Requested boards that answered, by serial number."""
    troubles: dict[str, str]
    """Reason why a requested board is missing, by serial number."""
    strangers: tuple[str, ...]
    """Serial numbers of boards that were found but not requested."""

    def in_no_module(self, robot: RobotConfig) -> str:
        """Return a note about plugged-in boards that belong to no module of the robot, or ""."""
        known = {module.serial_number.upper() for module in robot.module}
        strangers = ", ".join(serial for serial in self.strangers if serial not in known)
        return f"; plugged in, but in no [[module]]: {strangers}" if strangers else ""


def equal(one: Value, other: Value) -> bool:
    """Return True if two values are equal in the single precision of a board."""
    if isinstance(one, float) and isinstance(other, int | float):
        if math.isnan(one) and math.isnan(other):
            return True
        return math.isclose(one, other, rel_tol=1e-6)
    if isinstance(other, float) and isinstance(one, int):
        return equal(other, one)
    return one == other


def is_known(firmware: tuple[int, int, int]) -> bool:
    """Return True if the settings of a firmware have the names used here."""
    return firmware >= OLDEST and firmware[:2] == FIRMWARE[:2]


def describe_firmware(firmware: tuple[int, int, int]) -> str:
    """Return a version as text, such as "0.5.6"."""
    return ".".join(map(str, firmware))


def number(values: Mapping[str, Value], name: str) -> float:
    """Return a value; raise DriveError if it is not a number."""
    value = values.get(name)
    if not isinstance(value, int | float):
        raise DriveError(
            f"{name}: not a number; the board must be an ODrive v3 with firmware 0.5.x"
        )
    return value


class BoardBackup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All settings of one board."""

    module: str
    serial_number: str
    firmware: str
    settings: dict[str, Value]
    """Values by the firmware's names; inf, -inf and nan are text."""


class Backup(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Backup file."""

    time: str
    """Time of the backup, ISO 8601, local time with its UTC offset."""
    robot_file: str
    boards: tuple[BoardBackup, ...]


def backup_of(module: str, board: Board) -> BoardBackup:
    """Return a board's backup, with numbers in a form that JSON allows."""
    plain = {
        name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in board.read(board.settings).items()
    }
    return BoardBackup(module, board.serial_number, describe_firmware(board.firmware), plain)


def settings_of(backup: BoardBackup) -> dict[str, Value]:
    """Return a backup's settings with the original numbers."""
    return {
        name: _NOT_JSON.get(value, value) if isinstance(value, str) else value
        for name, value in backup.settings.items()
    }


def write_backup(path: Path, boards: Sequence[BoardBackup], *, time: str, robot_file: str) -> None:
    """Write a backup atomically; an existing file is never overwritten."""
    backup = Backup(time=time, robot_file=robot_file, boards=tuple(boards))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path, exclusive=True, lasting=True) as file:
            file.write(msgspec.json.format(msgspec.json.encode(backup)) + b"\n")
    except OSError as error:
        raise DriveError(
            f"{path}: the backup cannot be written: {error.strerror}; nothing was changed"
        ) from None


def read_backup(path: Path) -> Backup:
    """Read a backup."""
    try:
        return msgspec.json.decode(read_text(path), type=Backup)
    except OSError as error:
        raise DriveError(f"{path}: cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeError) as error:
        raise DriveError(f"{path}: not a backup from `xrl drive configure`: {error}") from None


class SettingChange(NamedTuple):
    """One setting that differs from the wanted value."""

    module: str
    name: str
    before: Value
    after: Value
    """Value to write."""
    why: str
    inhibit: str
    """Reason why it cannot be written, or ""."""
    fits: Callable[[Value], bool]
    """Checks whether a value is as wanted."""


class ChangeResult(NamedTuple):
    """Result of one change."""

    change: SettingChange
    now: Value
    """Value read back after the restart."""
    good: bool


def changes_to_wanted(
    module: str, wanted: Iterable[WantedSetting], board: Board
) -> list[SettingChange]:
    """Return the settings of a board that differ from the wanted ones."""
    settings = board.read(board.settings)
    calibrated = board.read([f"{axis}.{name}" for axis in AXES for name in _CALIBRATED.values()])
    changes = []
    for row in wanted:
        before, fits = settings.get(row.name), partial(_fits, row)
        inhibit = "missing in this firmware; 0.5.6 has it"
        if row.name in settings:
            inhibit = _uncalibrated(row.name, calibrated)
        if row.name not in settings or not fits(before):
            changes.append(
                SettingChange(module, row.name, before, row.value, row.why, inhibit, fits)
            )
    return changes


def against_backup(module: str, saved: Mapping[str, Value], board: Board) -> list[SettingChange]:
    """Return the settings of a board that differ from a backup."""
    settings = board.read(board.settings)
    changes = []
    for name, value in saved.items():
        before, fits, inhibit = settings.get(name), partial(equal, value), ""
        if name not in settings:
            inhibit = "missing in this board's firmware"
        elif name.partition(".")[2] in _FOUND:
            inhibit = "calibration measures it for the present wiring, so the board keeps its value"
        if name not in settings or not fits(before):
            changes.append(SettingChange(module, name, before, value, "", inhibit, fits))
    return changes


def refuse_armed(module: str, board: Board) -> None:
    """Raise DriveError if an axis of a board is not idle: saving restarts the board."""
    for axis, state in zip(AXES, board.states(), strict=True):
        if state != AxisState.IDLE:
            known = state in AxisState.__members__.values()
            words = AxisState(state).name if known else str(state)
            raise DriveError(
                f"{module}.{axis} is in {words}, not idle. Saving would restart the board, and the "
                "module would go limp. Hang the robot, then run `xrl down` or cycle the power"
            )


def write_changes(board: Board, changes: Sequence[SettingChange]) -> list[ChangeResult]:
    """Write changes to a board, save them, and read them back after the restart."""
    to_write = sorted((change for change in changes if not change.inhibit), key=_watchdog_order)
    if to_write:
        board.write({change.name: change.after for change in to_write})
        board.save()
    now = board.read([change.name for change in changes])
    return [
        ChangeResult(c, now.get(c.name), c.name in now and c.fits(now[c.name])) for c in changes
    ]


def _watchdog_order(change: SettingChange) -> float:
    """Return the rank of a change: watchdogs are disabled first, and enabled last."""
    if not change.name.endswith(".config.enable_watchdog"):
        return 0.0
    return 1.0 if change.after else -1.0


def describe_setting(value: Value) -> str:
    """Return a setting's value as a person would write it."""
    return "-" if value is None else describe_value(value)


def difference_table(difference: Sequence[SettingChange]) -> Group:
    """Return a table of the changes for the terminal, with the reasons below it."""
    columns = (Column("module", no_wrap=True), Column("setting", no_wrap=True), "now", "new")
    rows = Table(*columns, title="difference", title_justify="left", box=box.SIMPLE_HEAD)
    reasons: dict[str, None] = {}
    for change in difference:
        head, _, tail = change.name.rpartition(".")
        name = f"{head}.\n{tail}" if head else tail
        values = map(describe_setting, (change.before, change.after))
        rows.add_row(change.module, name, *values)
        if change.why:
            reasons[f"{tail}: {change.why}"] = None
        if change.inhibit:
            reasons[f"{change.module} {change.name} cannot be written: {change.inhibit}"] = None
    return Group(rows, *(Padding(Text(reason), (0, 0, 0, 2), expand=False) for reason in reasons))


def _fits(row: WantedSetting, value: Value) -> bool:
    return isinstance(value, bool | int | float) and row.fits(value)


def _uncalibrated(name: str, calibrated: Mapping[str, Value]) -> str:
    """Return why a setting that needs calibration cannot be written yet, or ""."""
    axis, _, below = name.partition(".")
    status = _CALIBRATED.get(below)
    if status is None or calibrated.get(f"{axis}.{status}"):
        return ""
    return f"not calibrated: {CALIBRATE}"
