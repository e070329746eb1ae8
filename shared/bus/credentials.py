"""A host's certificates and keys, as `xrl keys pack` packs them (docs/security.md).

authority.pem     certificate of the robot's authority
names.toml        the robot, and the current generation of each name
NAME.pem          certificate of NAME.GENERATION, for each process that this host runs
NAME.key          its private key, readable by its owner alone
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from shared.bus.topics import OPERATOR, PRINCIPALS, VIEWER
from shared.config.endpoints import ROBOT, filled
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import BusError, ConfigError, FleetError
from shared.places import in_home
from shared.toml_file import Section, read_toml

AUTHORITY: Final = "authority.pem"
NAMES: Final = "names.toml"
_HELP: Final = "make this host's keys with `xrl keys pack` (docs/security.md)"


class Names(Section, frozen=True):
    """Content of `names.toml`: the robot's name and the certified names."""

    robot: str
    generations: dict[str, int]
    """Current generation of each name; certificates of earlier generations are rejected."""


class Credentials(NamedTuple):
    """Certificate and key of one process, and the names that it trusts."""

    name: str
    """One of `PRINCIPALS`."""
    certificate: Path
    key: Path
    authority: Path
    generations: dict[str, int]


def keys_folder(robot: RobotConfig) -> Path:
    """Return the folder `bus.security.keys`; raise XrlError if its `~` names no existing home."""
    return in_home(filled(robot.bus.security.keys, {ROBOT: robot.name}))


def certificate_file(folder: Path, name: str) -> Path:
    """Return the path of a name's certificate."""
    return folder / f"{name}.pem"


def key_file(folder: Path, name: str) -> Path:
    """Return the path of a name's private key."""
    return folder / f"{name}.key"


def read_names(folder: Path) -> Names:
    """Read `names.toml` of a folder; raise BusError if it is missing or invalid."""
    file = folder / NAMES
    if not file.is_file():
        raise BusError(f"{folder}: no keys for `mtls` here ({NAMES} is missing); {_HELP}")
    try:
        names = read_toml(file, Names)
    except ConfigError as error:
        raise BusError(str(error)) from None
    strange = sorted(set(names.generations) - set(PRINCIPALS))
    if strange:
        right = f"use one of {', '.join(PRINCIPALS)}"
        raise BusError(f"{file}: generations.{strange[0]}: not a valid name; {right}")
    return names


def held_names(folder: Path) -> frozenset[str]:
    """Return the current names whose private keys a folder holds; raise as `read_names` does."""
    return frozenset(n for n in read_names(folder).generations if key_file(folder, n).exists())


def read_credentials(robot: RobotConfig, process: str) -> Credentials:
    """Return the credentials of a process of this host.

    A tool is the operator if this host has the operator's key, else a viewer. Raises BusError if a
    file is missing, belongs to another robot, or is readable by others.
    """
    folder = keys_folder(robot)
    names = read_names(folder)
    if names.robot != robot.name:
        raise BusError(
            f"{folder}: these are the keys of robot {names.robot!r}, not of {robot.name!r}; {_HELP}"
        )
    wanted = (process,) if process in SERVICES else (OPERATOR, VIEWER)
    name = next((name for name in wanted if key_file(folder, name).exists()), wanted[-1])
    certificate, key = certificate_file(folder, name), key_file(folder, name)
    credentials = Credentials(name, certificate, key, folder / AUTHORITY, names.generations)
    for file in (credentials.certificate, credentials.key, credentials.authority):
        if not file.is_file():
            raise BusError(
                f"{file}: missing: this process needs the key of {' or '.join(wanted)}; {_HELP}"
            )
    check_private(credentials.key)
    return credentials


def require_operator(robot: RobotConfig, process: str) -> None:
    """Under `mtls`, check that this host has an operator's key; other modes identify no sender.

    Raises BusError if this host has no key, FleetError if the key is not an operator's.
    """
    if robot.bus.security.mode != "mtls":
        return
    name = read_credentials(robot, process).name
    if name != OPERATOR:
        raise FleetError(
            f"this host has the key of a {name}; this command needs an operator's key, from "
            "`xrl keys pack` (docs/security.md)"
        )


def check_private(key: Path) -> None:
    """Raise BusError unless a private key belongs to this user, who alone can read it."""
    found = key.stat()
    if found.st_uid != os.geteuid():
        raise BusError(f"{key}: belongs to another user; the service's user must own it")
    if stat.S_IMODE(found.st_mode) & 0o077:
        raise BusError(f"{key}: other users can read it; run `chmod 600 {key}`")
    try:
        key.read_bytes()
    except OSError as error:
        raise BusError(f"{key}: {error.strerror}") from None


def to_toml(names: Names) -> bytes:
    """Return the text of `names.toml`."""
    return msgspec.toml.encode(names)
