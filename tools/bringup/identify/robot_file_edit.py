"""Writes measured values into a robot file: its comments stay, and a backup of it is made first."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from shared.atomic_file import atomic_file, replace_file
from shared.config import files as config_file
from shared.exceptions import RunError
from shared.text_file import read_text
from tools.bringup.identify.estimates import Value


def edited(text: str, file: str, values: Mapping[str, Value], measured: Collection[str]) -> str:
    """Return a robot file's text with new values, checked as a robot.

    Args:
        text: of the file.
        file: its name, for errors.
        values: new ones by dotted key.
        measured: keys that come off the list of what is assumed.

    Raises:
        RunError: it is no TOML.
        ConfigError: it would be no robot file that can be used.
    """
    try:
        document = tomlkit.parse(text)
    except TOMLKitError as error:
        raise RunError(f"{file}: no TOML file: {error}") from None
    for key, value in values.items():
        section, name = key.split(".")
        table: Any = document[section]
        table[name] = list(value) if isinstance(value, tuple) else value
    assumed: Any = document.get("assumed", [])
    for key in [str(key) for key in assumed if str(key) in measured]:
        assumed.remove(key)
    new = tomlkit.dumps(document)
    config_file.parse(new, file)
    return new


def apply(path: Path, values: Mapping[str, Value], measured: Collection[str], stamp: str) -> Path:
    """Write new values into a robot file; return its backup.

    Args:
        path: of the robot file.
        values: new ones by dotted key.
        measured: keys that come off the list of what is assumed.
        stamp: of the time, in the backup's name.

    Raises:
        RunError: a file cannot be read or written, or there is such a backup already; the robot
            file is then as it was.
        ConfigError: the new values make no robot file that can be used.
    """
    try:
        text = read_text(path)
        new = edited(text, str(path), values, measured)
        backup = path.with_name(f"{path.name}.{stamp}.bak")
        with atomic_file(backup, exclusive=True) as file:
            file.write(text.encode())
        replace_file(path, new.encode())
    except (OSError, UnicodeError) as error:
        raise RunError(f"{path}: not changed: {error}") from None
    return backup
