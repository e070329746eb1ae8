"""`xrl keys`: one authority per robot, one certificate per process, one bundle per host."""

from __future__ import annotations

from collections.abc import Sequence, Sized
from pathlib import Path
from typing import Annotated, Final

from rich import box
from rich.table import Table
from rich.text import Text

from shared.bus.credentials import keys_folder
from shared.config import files as config_file
from shared.config.endpoints import ROBOT, filled
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, BusError
from tools.flags import Arg, ConfigFlags, Count, Folder, option, positional
from tools.hosts import hosts_file
from tools.hosts.layout import robot_on_hosts
from tools.keys.authority import (
    Authority,
    bundle,
    default_folder,
    install,
    principals_of,
    to_tar,
)
from tools.keys.authority import make as new_authority
from tools.keys.certificates import CERTIFICATE_DAYS
from tools.keys.inspection import KeyRow, inspect_keys
from tools.output import write_atomically
from tools.terminal import Console

EXAMPLES: Final = """
xrl keys make --config lab.toml                       # once, on the computer that keeps the keys
xrl keys make --hosts hosts.toml                      # ... for a robot on several hosts
xrl keys pack planner harness recorder operator -o body.keys.tar
xrl keys pack --install
xrl keys check
xrl keys renew --all                                  # before they expire
xrl keys revoke operator                              # after a laptop was lost
"""


class KeysFlags(ConfigFlags):
    """Robot and authority of the keys."""

    hosts: Path | None = None
    """hosts file with the services' addresses (default: those in the robot file)"""
    authority: Folder | None = None
    """folder of the certificate authority (default: ~/.config/xrl/ROBOT/authority)"""

    def robot(self) -> RobotConfig:
        """Return the robot, with the addresses of its hosts."""
        robot = config_file.load(self.config)
        if self.hosts is not None:
            robot = robot_on_hosts(robot, hosts_file.load(self.hosts, robot))
        return robot


class MakeFlags(KeysFlags):
    """Lifetime of the certificates."""

    days: Annotated[Count, Arg(metavar="DAYS")] = CERTIFICATE_DAYS
    """days until the certificates expire"""


class RenewFlags(MakeFlags):
    """Certificates to replace."""

    names: Annotated[tuple[str, ...], positional("NAME", one_of="which")] = ()
    """certificates, such as planner or operator"""
    all: Annotated[bool, Arg(one_of="which")] = False
    """all certificates"""


class PackFlags(KeysFlags):
    """Certificates to pack, and their destination."""

    names: Annotated[tuple[str, ...], positional("NAME")] = ()
    """services and roles of the host (default: all)"""
    out: Annotated[Path | None, option("-o", "--out", metavar="FILE", one_of="out")] = None
    """tar file to write; it contains keys/"""
    install: Annotated[bool, Arg(one_of="out")] = False
    """install on this host, in bus.security.keys"""


def make(flags: MakeFlags) -> int:
    """Make the authority."""
    robot = flags.robot()
    authority = new_authority(_authority_folder(flags, robot), robot, flags.days)
    print(f"{authority.folder}: authority of {robot.name!r}, {_count(authority.names.generations)}")
    print("keep authority.key here; `xrl keys pack NAME ... -o FILE` packs the keys of a host")
    return 0


def pack(flags: PackFlags) -> int:
    """Pack for one host, or install here."""
    robot = flags.robot()
    authority = _opened(flags, robot)
    names = flags.names or list(authority.names.generations)
    files = bundle(authority, names)
    if flags.out is None:
        folder = keys_folder(robot)
        install(files, folder)
        print(f"{folder}: {_count(names)}")
        return 0
    write_atomically(flags.out, to_tar(files), private=True)
    folder = Path(filled(robot.bus.security.keys, {ROBOT: robot.name})).parent
    print(f"{flags.out}: {_count(names)}; copy it to the host that it is for, and run there:")
    print(f"mkdir -p {folder} && tar -xf {flags.out.name} -C {folder}")
    return 0


def check(flags: KeysFlags) -> int:
    """Check this host's keys, or the authority's."""
    robot = flags.robot()
    folder = keys_folder(robot) if flags.authority is None else flags.authority
    rows = inspect_keys(folder, robot)
    Console().print(_table(folder, rows))
    return 0 if all(not row.wrong for row in rows) else FAULT_EXIT_CODE


def renew(flags: RenewFlags) -> int:
    """Make new certificates."""
    robot = flags.robot()
    authority, names = _named(flags, robot)
    authority.renew(robot, names, flags.days)
    print(f"{authority.folder}: {_count(names)} renewed; pack them for their hosts")
    return 0


def revoke(flags: RenewFlags) -> int:
    """Make certificates of the next generation, in place of those that are revoked."""
    robot = flags.robot()
    authority, names = _named(flags, robot)
    authority.revoke(robot, names, flags.days)
    current = ", ".join(f"{name}.{authority.names.generations[name]}" for name in names)
    print(f"{authority.folder}: now {current}")
    print(
        "pack the keys of ALL hosts (or run `xrl hosts update`) and restart the fleet; until then"
    )
    print("it accepts the old certificates")
    return 0


def _authority_folder(flags: KeysFlags, robot: RobotConfig) -> Path:
    return flags.authority or default_folder(robot)


def _opened(flags: KeysFlags, robot: RobotConfig) -> Authority:
    authority = Authority(_authority_folder(flags, robot))
    if authority.names.robot != robot.name:
        right = f"give the authority of {robot.name!r} with --authority"
        raise BusError(
            f"{authority.folder}: is the authority of {authority.names.robot!r}; {right}"
        )
    return authority


def _named(flags: RenewFlags, robot: RobotConfig) -> tuple[Authority, Sequence[str]]:
    authority = _opened(flags, robot)
    names = principals_of(robot) if flags.all else flags.names
    for name in names:
        if name not in principals_of(robot):
            raise BusError(f"{name!r}: must be one of {', '.join(principals_of(robot))}")
    return authority, names


def _count(names: Sized) -> str:
    return f"{len(names)} certificate{'s' if len(names) != 1 else ''}"


def _table(folder: Path, rows: list[KeyRow]) -> Table:
    table = Table(title=str(folder), title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("name", "from", "expires", "host names", ""):
        table.add_column(heading, no_wrap=heading != "")
    for row in rows:
        words = Text(row.wrong, "bold red") if row.wrong else Text(row.warning, "yellow")
        table.add_row(row.name, row.begins, row.expires, ", ".join(row.hosts) or "-", words or "ok")
    return table
