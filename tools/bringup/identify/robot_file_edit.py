"""Writes measured values into a robot file: its comments stay, and a backup of it is made first."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from shared.atomic_file import atomic_file, replace_file
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.places import refuse_shipped
from shared.toml_file import read_text
from tools.bringup.identify.estimates import Value
from tools.fleet import procfs
from tools.fleet.run_dir import RunDir


def edited(text: str, file: str, values: Mapping[str, Value], measured: Collection[str]) -> str:
    """Return a robot file's text with new values by dotted key, checked as a robot.

    The measured keys come off the list of what is assumed.
    """
    try:
        document = tomlkit.parse(text)
    except TOMLKitError as error:
        raise RunError(f"{file}: not a TOML file: {error}") from None
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
    """Write new values into a robot file; return its backup, named by a stamp of the time.

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


def refuse_running(path: Path) -> None:
    """Refuse to write the robot file of a fleet that is up: a restarted service would read it."""
    refuse_shipped(path)
    for place in sorted(procfs.fleets()):
        manifest = RunDir(Path(place)).read_manifest()
        if manifest is not None and Path(manifest.config).resolve() == path.resolve():
            raise RunError(
                f"{path}: the fleet in {place} runs with it; measure without --apply, `xrl down "
                f"--run-dir {place}`, then --apply (`xrl drive identify body RECORD --apply`)"
            )


def refuse_other_robot(path: Path, robot: RobotConfig, values: Mapping[str, Value]) -> None:
    """Refuse to write what was measured against another file than the one to be written."""
    file = config_file.load_without_schedule(path)
    if file.name != robot.name:
        raise RunError(f"{path}: the robot {file.name}; the record is of {robot.name}")
    for key in values:
        section, name = key.split(".")
        here, there = (getattr(getattr(one, section), name) for one in (file, robot))
        if here != there:
            raise RunError(
                f"{path}: {key} is {here}, and was {there} when the record was made; give that "
                "robot's file as --config, or record again"
            )
