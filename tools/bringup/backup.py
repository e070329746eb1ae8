"""Backups of boards' settings in a file, written before anything is changed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from shared.atomic_file import atomic_file
from shared.exceptions import DriveError
from shared.toml_file import read_text
from tools.bringup.boards import Board, Value, describe_firmware

VERSION: Final = 1
_NOT_JSON: Final = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
"""Numbers that JSON does not have, as they stand in the file."""


class BoardBackup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All settings of one board."""

    module: str
    serial_number: str
    firmware: str
    settings: dict[str, Value]
    """By the firmware's names; inf, -inf and nan as text."""


class Backup(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The file."""

    version: int = VERSION
    time: str
    """When it was made, ISO 8601, local time with its offset."""
    robot_file: str
    boards: tuple[BoardBackup, ...]


def of_board(module: str, board: Board) -> BoardBackup:
    """Return a board's backup, with its numbers as JSON can have them."""
    plain = {name: _to_json(value) for name, value in board.read(board.settings).items()}
    return BoardBackup(module, board.serial_number, describe_firmware(board.firmware), plain)


def settings_of(backup: BoardBackup) -> dict[str, Value]:
    """Return a backup's settings with their numbers as they were."""
    return {
        name: _NOT_JSON.get(value, value) if isinstance(value, str) else value
        for name, value in backup.settings.items()
    }


def write(path: Path, boards: Sequence[BoardBackup], *, time: str, robot_file: str) -> None:
    """Write a backup; the file is whole or not there, and none is ever overwritten.

    Raises:
        DriveError: it cannot be written.
    """
    backup = Backup(time=time, robot_file=robot_file, boards=tuple(boards))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path, exclusive=True, lasting=True) as file:
            file.write(msgspec.json.format(msgspec.json.encode(backup)) + b"\n")
    except OSError as error:
        raise DriveError(
            f"{path}: the backup cannot be written: {error.strerror}; nothing was changed"
        ) from None


def read(path: Path) -> Backup:
    """Read a backup."""
    try:
        backup = msgspec.json.decode(read_text(path), type=Backup)
    except OSError as error:
        raise DriveError(f"{path}: cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, UnicodeError) as error:
        raise DriveError(f"{path}: not a backup of `xrl drive configure`: {error}") from None
    if backup.version != VERSION:
        raise DriveError(f"{path}: a backup of version {backup.version}, not {VERSION}")
    return backup


def _to_json(value: Value) -> Value:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
