"""Folder of a robot's authority, and the bundles that it makes for hosts.

The authority signs certificates. Its key never leaves its computer: a host's bundle has only the
keys of the host's own processes.

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
    """Authority of a robot, read from its folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.names = credentials.read_names(folder)
        key = folder / _KEY
        if not key.is_file():
            raise BusError(f"{key}: missing, so this folder cannot sign; give another --authority")
        credentials.check_private(key)
        self._issued = Issued((folder / credentials.AUTHORITY).read_bytes(), key.read_bytes())

    @property
    def certificate(self) -> bytes:
        """Certificate of the authority, PEM."""
        return self._issued.certificate

    def renew(self, robot: RobotConfig, names: Iterable[str], days: int) -> None:
        """Issue new certificates and keys in the current generation; old ones remain accepted."""
        self._issue(robot, {name: self.names.generations.get(name, 1) for name in names}, days)

    def revoke(self, robot: RobotConfig, names: Iterable[str], days: int) -> None:
        """Issue the next generation; hosts with the new `names.toml` refuse the old one."""
        self._issue(robot, {n: self.names.generations.get(n, 0) + 1 for n in names}, days)

    def _issue(self, robot: RobotConfig, generations: Mapping[str, int], days: int) -> None:
        """Issue all certificates, write them, and then write the accepted generations."""
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
        raise BusError(f"{folder}: already has an authority; {right}")
    names = Names(robot.name, dict.fromkeys(principals_of(robot), 1))
    for name in names.generations:
        hosts_of(robot, name)  # raise before anything is written
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
    """Return the names of all certificates of a robot."""
    return tuple(n for n in PRINCIPALS if n not in SERVICES or n in robot.services)


def hosts_of(robot: RobotConfig, name: str) -> tuple[str, ...]:
    """Return the host of a service's endpoint; empty for tools, which do not listen."""
    if name not in SERVICES:
        return ()
    endpoint = robot.bus.endpoints[name]
    found = re.fullmatch(r"tls/\[?([^\]]+?)\]?:\d+", endpoint)
    if found is None:
        raise BusError(
            f"bus.endpoints.{name}: {endpoint!r} cannot have a certificate; must be tls/HOST:PORT. "
            "For a robot on several hosts, give --hosts FILE"
        )
    return (found[1],)


def bundle(authority: Authority, names: Iterable[str]) -> dict[str, bytes]:
    """Return the files of a bundle, by name."""
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
    """Return a tar file of the folder `keys`, whose files only their owner can read."""
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
    """Write a bundle into this host's folder of keys, and delete keys that the bundle lacks."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        for name, content in files.items():
            replace_file(folder / name, content, private=True)
        for old in set(held_files(folder)) - set(files):
            (folder / old).unlink()
    except OSError as error:
        raise BusError(f"{folder}: cannot be written: {error.strerror}") from None
