"""Check a host's keys for `xrl keys check`, `xrl doctor` and `xrl hosts check`."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Final, NamedTuple

from shared.bus import credentials
from shared.bus.credentials import Names, certificate_file, key_file
from shared.bus.security import common_name
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import BusError
from tools.keys import certificates
from tools.keys.authority import hosts_of
from tools.keys.certificates import Details

_DAY: Final = "%Y-%m-%d"
_TIME: Final = "%Y-%m-%d %H:%M UTC"
WARN_DAYS: Final = 60
"""Time before expiry at which warnings begin, days."""


class KeyRow(NamedTuple):
    """Result of the check of one certificate."""

    name: str
    begins: str
    expires: str
    hosts: tuple[str, ...]
    wrong: str = ""
    """Reason why it cannot be used, or ""."""
    warning: str = ""


def inspect_keys(folder: Path, robot: RobotConfig) -> list[KeyRow]:
    """Return a row for each certificate in a folder; the authority's is first."""
    names = credentials.read_names(folder)
    if names.robot != robot.name:
        right = f"must be those of {robot.name!r}"
        raise BusError(f"{folder}: keys of robot {names.robot!r}; {right}")
    try:
        authority = (folder / credentials.AUTHORITY).read_bytes()
        signer = certificates.read(authority)
    except (OSError, ValueError) as error:
        raise BusError(
            f"{folder / credentials.AUTHORITY}: cannot be read as a certificate: {error}"
        ) from None
    held = [name for name in names.generations if key_file(folder, name).exists()]
    if not held:
        raise BusError(f"{folder}: has no certificate of a process; run `xrl keys pack`")
    own = _row(signer, *_validity(signer, "make a new authority: `xrl keys make --authority DIR`"))
    return [own, *(_inspect(folder, robot, names, name, authority) for name in held)]


def _validity(found: Details, renewal: str) -> tuple[str, str]:
    """Return a fault and a warning about a certificate's dates by this host's clock, or ""."""
    now = dt.datetime.now(dt.UTC)
    left = found.expires - now
    if now < found.begins:
        wrong = f"not valid before {found.begins:{_TIME}}, but this host's clock says {now:{_TIME}}"
        return f"{wrong}: no new link is possible; set the clock", ""
    if left < dt.timedelta():
        wrong = f"expired at {found.expires:{_TIME}}, but this host's clock says {now:{_TIME}}"
        return f"{wrong}: no new link is possible; {renewal}", ""
    if left < dt.timedelta(days=WARN_DAYS):
        return "", f"expires in {left.days} day{'s' * (left.days != 1)}; {renewal}"
    return "", ""


def _row(found: Details, wrong: str, warning: str) -> KeyRow:
    return KeyRow(
        name=found.common_name,
        begins=f"{found.begins:{_DAY}}",
        expires=f"{found.expires:{_DAY}}",
        hosts=found.hosts,
        wrong=wrong,
        warning=warning,
    )


def _inspect(folder: Path, robot: RobotConfig, names: Names, name: str, authority: bytes) -> KeyRow:
    try:
        credentials.check_private(key_file(folder, name))
        certificate = certificate_file(folder, name).read_bytes()
        found = certificates.read(certificate)
    except (OSError, ValueError, BusError) as error:
        return KeyRow(name, "-", "-", (), str(error))
    current = common_name(name, names.generations[name])
    wrong, warning = _validity(found, f"run `xrl keys renew {name}`, then pack")
    wanted = hosts_of(robot, name)
    if not certificates.is_signed_by(certificate, authority):
        wrong = "signed by another authority; run `xrl keys pack` again"
    elif not certificates.is_key_of(key_file(folder, name).read_bytes(), certificate):
        wrong = "its key is that of another certificate; run `xrl keys pack` again"
    elif found.common_name != current:
        wrong = f"{found.common_name}, but only {current} is accepted; run `xrl keys pack` again"
    elif not wrong and name in SERVICES and not set(wanted) <= set(found.hosts):
        wrong = f"not for {wanted[0]}, its host in the robot file; run `xrl keys renew {name}`"
    return _row(found, wrong, warning)
