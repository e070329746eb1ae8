"""Folder of a robot's authority, and the bundles that it makes for hosts.

The authority signs certificates, and never leaves its machine. A host's bundle has certificates and
keys of what the host runs, and never the authority's key.

authority.key, authority.pem    the authority
names.toml                      the current generation of each name
NAME.pem, NAME.key              the current certificate of each name
"""

from __future__ import annotations

import datetime as dt
import io
import re
import tarfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from shared.atomic_file import replace_file
from shared.bus import credentials
from shared.bus.credentials import Names, certificate_file, key_file
from shared.bus.security import common_name
from shared.bus.topics import PRINCIPALS
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import BusError
from shared.places import in_home
from tools.keys import certificates
from tools.keys.certificates import Issued

_KEY: Final = "authority.key"


def default_folder(robot: RobotConfig) -> Path:
    """Return the default folder of a robot's authority."""
    return in_home("~/.config/xrl") / robot.name / "authority"


class Authority:
    """A robot's authority, as its folder holds it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = credentials.read_names(folder)
        key = folder / _KEY
        if not key.is_file():
            raise BusError(f"{key}: missing, so this folder cannot sign; give --authority")
        credentials.check_private(key)
        self._issued = Issued((folder / credentials.AUTHORITY).read_bytes(), key.read_bytes())

    @property
    def certificate(self) -> bytes:
        """The authority's own certificate, PEM."""
        return self._issued.certificate

    def renew(self, robot: RobotConfig, names: Iterable[str], days: int) -> None:
        """Issue new certificates and keys in the current generation; the old ones stay valid."""
        self._issue(robot, {name: self.names.generations.get(name, 1) for name in names}, days)

    def revoke(self, robot: RobotConfig, names: Iterable[str], days: int) -> None:
        """Issue the next generation; once all hosts know of it, none accepts the old one."""
        self._issue(robot, {n: self.names.generations.get(n, 0) + 1 for n in names}, days)

    def _issue(self, robot: RobotConfig, generations: Mapping[str, int], days: int) -> None:
        """Issue all certificates, then write them, and last the generations that are accepted."""
        now = dt.datetime.now(dt.UTC)
        issued = {
            name: certificates.issue(
                self._issued, common_name(name, generation), hosts_of(robot, name), now, days
            )
            for name, generation in generations.items()
        }
        for name, made in issued.items():
            replace_file(key_file(self.folder, name), made.key, private=True)
            replace_file(certificate_file(self.folder, name), made.certificate, private=True)
        self.names = Names(self.names.robot, {**self.names.generations, **generations})
        replace_file(self.folder / credentials.NAMES, credentials.to_toml(self.names), private=True)


def make(folder: Path, robot: RobotConfig, days: int) -> Authority:
    """Create a robot's authority and a certificate for each name."""
    if (folder / _KEY).exists():
        right = "`xrl keys renew` makes new certificates, `xrl keys revoke` revokes old ones"
        raise BusError(f"{folder}: has an authority already; {right}")
    names = Names(robot.name, dict.fromkeys(principals_of(robot), 1))
    for name in names.generations:
        hosts_of(robot, name)  # before anything is written
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
    except OSError as error:
        raise BusError(f"{folder}: cannot be created: {error.strerror}") from None
    own = certificates.make_authority(robot.name, dt.datetime.now(dt.UTC))
    replace_file(folder / credentials.AUTHORITY, own.certificate, private=True)
    replace_file(folder / credentials.NAMES, credentials.to_toml(names), private=True)
    replace_file(folder / _KEY, own.key, private=True)
    authority = Authority(folder)
    authority.renew(robot, names.generations, days)
    return authority


def principals_of(robot: RobotConfig) -> tuple[str, ...]:
    """Return every name that a robot's certificates have."""
    return tuple(n for n in PRINCIPALS if n not in SERVICES or n in robot.services)


def hosts_of(robot: RobotConfig, name: str) -> tuple[str, ...]:
    """Return the host by which a service is dialled; empty for tools, which listen nowhere."""
    if name not in SERVICES:
        return ()
    endpoint = robot.bus.endpoints[name]
    found = re.fullmatch(r"tls/\[?([^\]]+?)\]?:\d+", endpoint)
    if found is None:
        raise BusError(
            f"bus.endpoints.{name}: {endpoint!r} has no certificate; must be tls/HOST:PORT, "
            "or give --hosts FILE for a robot on several hosts"
        )
    return (found[1],)


def bundle(authority: Authority, names: Iterable[str]) -> dict[str, bytes]:
    """Return the files of a bundle by their names."""
    folder = authority.folder
    files = {
        credentials.AUTHORITY: authority.certificate,
        credentials.NAMES: credentials.to_toml(authority.names),
    }
    for name in names:
        if name not in authority.names.generations:
            right = f"use one of {', '.join(authority.names.generations)}"
            raise BusError(f"{name!r} has no certificate here; {right}")
        for file in (certificate_file(folder, name), key_file(folder, name)):
            try:
                files[file.name] = file.read_bytes()
            except OSError as error:
                raise BusError(f"{file}: {error.strerror}; run `xrl keys renew {name}`") from None
    return files


def to_tar(files: dict[str, bytes]) -> bytes:
    """Return a tar file that unpacks into one folder; only its owner can read the files."""
    written = io.BytesIO()
    with tarfile.open(fileobj=written, mode="w") as tar:
        for name, content in files.items():
            entry = tarfile.TarInfo(f"keys/{name}")
            entry.size, entry.mode = len(content), 0o600
            tar.addfile(entry, io.BytesIO(content))
    return written.getvalue()


def held_files(folder: Path) -> list[str]:
    """Return the names of the certificates and keys in a folder."""
    return sorted(path.name for path in folder.iterdir() if path.suffix in (".pem", ".key"))


def install(files: dict[str, bytes], folder: Path) -> None:
    """Write a bundle into this host's folder of keys, and delete keys that are not in it."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        for name, content in files.items():
            replace_file(folder / name, content, private=True)
        for old in set(held_files(folder)) - set(files):
            (folder / old).unlink()
    except OSError as error:
        raise BusError(f"{folder}: cannot be written: {error.strerror}") from None
