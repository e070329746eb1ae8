"""`xrl keys`: one authority per robot, one certificate per process, one bundle per host."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich import box
from rich.table import Table
from rich.text import Text

from shared.bus.credentials import keys_folder
from shared.bus.topics import PRINCIPALS
from shared.config import files as config_file
from shared.config.endpoints import ROBOT, filled
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, BusError
from tools.hosts import hosts_file
from tools.hosts.layout import robot_on_hosts
from tools.keys.authority import (
    Authority,
    bundle,
    default_folder,
    install,
    make,
    principals_of,
    to_tar,
)
from tools.keys.certificates import CERTIFICATE_DAYS
from tools.keys.inspection import KeyRow, inspect_keys
from tools.number_arguments import count
from tools.output import write_atomically
from tools.terminal import Console
from tools.verb_table import Subparsers, add_config, add_verb

_EXAMPLES = """
xrl keys make --config lab.toml                       # once, where the keys are kept
xrl keys make --hosts hosts.toml                      # ... of a robot on several hosts
xrl keys pack planner harness recorder operator -o body.keys.tar
xrl keys pack --install                               # all, onto this host
xrl keys check                                        # this host's keys
xrl keys renew --all                                  # before they expire
xrl keys revoke operator                              # a laptop is lost
"""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb and what it does."""
    parser = add_verb(subparsers, "keys", _EXAMPLES)
    orders = parser.add_subparsers(metavar="WHAT", required=True)

    order = _order(orders, "make", "make a robot's authority, and a certificate for each process")
    _add_days(order)
    order.set_defaults(order=_make)

    order = _order(orders, "pack", "pack what one host needs: never the authority's key")
    order.add_argument("names", nargs="*", metavar="NAME", help="what runs there; none: everything")
    out = order.add_mutually_exclusive_group(required=True)
    out.add_argument("-o", "--out", type=Path, metavar="FILE", help="a tar file with keys/ in it")
    out.add_argument("--install", action="store_true", help="this host: write bus.security.keys")
    order.set_defaults(order=_pack)

    order = _order(orders, "check", "look at this host's keys; 0: all are right")
    order.set_defaults(order=_check)

    order = _order(orders, "renew", "make new certificates; the old ones go on to be let in")
    _add_names(order)
    _add_days(order)
    order.set_defaults(order=_renew)

    order = _order(orders, "revoke", "make certificates of the next generation, for lost ones")
    _add_names(order)
    _add_days(order)
    order.set_defaults(order=_revoke)


def run(args: argparse.Namespace) -> int:
    """Do what was asked for."""
    robot = config_file.load(args.config)
    if args.hosts is not None:
        robot = robot_on_hosts(robot, hosts_file.load(args.hosts, robot))
    return int(args.order(args, robot))


def _order(
    orders: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    words: str,
) -> argparse.ArgumentParser:
    order = orders.add_parser(name, help=words, description=f"{words[0].upper()}{words[1:]}.")
    add_config(order)
    order.add_argument(
        "--hosts",
        type=Path,
        metavar="FILE",
        help="services are at the addresses of this hosts file (default: as the robot file has it)",
    )
    order.add_argument(
        "--authority",
        type=Path,
        metavar="DIR",
        help="folder of the authority (default: ~/.config/xrl/ROBOT/authority)",
    )
    return order


def _add_names(parser: argparse.ArgumentParser) -> None:
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("names", nargs="*", default=[], metavar="NAME", help=", ".join(PRINCIPALS))
    which.add_argument("--all", action="store_true", help="all of them")


def _add_days(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--days",
        type=count,
        default=CERTIFICATE_DAYS,
        help="until the certificates expire (default: %(default)s)",
    )


def _authority_folder(args: argparse.Namespace, robot: RobotConfig) -> Path:
    folder: Path = default_folder(robot) if args.authority is None else args.authority
    return folder


def _make(args: argparse.Namespace, robot: RobotConfig) -> int:
    authority = make(_authority_folder(args, robot), robot, args.days)
    print(f"{authority.folder}: authority of {robot.name!r}, {_count(authority.names.generations)}")
    print("keep authority.key here; `xrl keys pack NAME ... -o FILE` packs what a host needs")
    return 0


def _pack(args: argparse.Namespace, robot: RobotConfig) -> int:
    authority = _opened(args, robot)
    names = args.names or list(authority.names.generations)
    files = bundle(authority, names)
    if args.install:
        folder = keys_folder(robot)
        install(files, folder)
        print(f"{folder}: {_count(names)}")
        return 0
    write_atomically(args.out, to_tar(files), private=True)
    folder = Path(filled(robot.bus.security.keys, {ROBOT: robot.name})).parent
    print(f"{args.out}: {_count(names)}; on that host:")
    print(f"mkdir -p {folder} && tar -xf {args.out.name} -C {folder}")
    return 0


def _check(args: argparse.Namespace, robot: RobotConfig) -> int:
    folder = keys_folder(robot) if args.authority is None else args.authority
    rows = inspect_keys(folder, robot)
    Console().print(_table(folder, rows))
    return 0 if all(not row.wrong for row in rows) else FAULT_EXIT_CODE


def _renew(args: argparse.Namespace, robot: RobotConfig) -> int:
    authority, names = _named(args, robot)
    authority.renew(robot, names, args.days)
    print(f"{authority.folder}: {_count(names)} renewed; pack them for their hosts, one by one")
    return 0


def _revoke(args: argparse.Namespace, robot: RobotConfig) -> int:
    authority, names = _named(args, robot)
    authority.revoke(robot, names, args.days)
    current = ", ".join(f"{name}.{authority.names.generations[name]}" for name in names)
    print(f"{authority.folder}: now {current}")
    print("pack for ALL hosts (or `xrl hosts update`) and restart the fleet; until then it lets")
    print("the old ones in")
    return 0


def _opened(args: argparse.Namespace, robot: RobotConfig) -> Authority:
    authority = Authority(_authority_folder(args, robot))
    if authority.names.robot != robot.name:
        right = f"that of {robot.name!r} is right: give --authority"
        raise BusError(f"{authority.folder}: authority of {authority.names.robot!r}; {right}")
    return authority


def _named(args: argparse.Namespace, robot: RobotConfig) -> tuple[Authority, list[str]]:
    authority = _opened(args, robot)
    names = list(principals_of(robot)) if args.all else args.names
    for name in names:
        if name not in principals_of(robot):
            raise BusError(f"{name!r}: no such name; one of {', '.join(principals_of(robot))}")
    return authority, names


def _count(names: object) -> str:
    count = len(names)  # type: ignore[arg-type]  # a list or a dict
    return f"{count} certificate{'s' if count != 1 else ''}"


def _table(folder: Path, rows: list[KeyRow]) -> Table:
    table = Table(title=str(folder), title_justify="left", box=box.SIMPLE_HEAD)
    for heading in ("name", "from", "expires", "dialled as", ""):
        table.add_column(heading, no_wrap=heading != "")
    for row in rows:
        words = Text(row.wrong, "bold red") if row.wrong else Text(row.warning, "yellow")
        table.add_row(row.name, row.begins, row.expires, ", ".join(row.hosts) or "-", words or "ok")
    return table
