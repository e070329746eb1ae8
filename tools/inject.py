"""`xrl inject`: make the network of a live fleet bad, on purpose and for a while."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from shared.exceptions import ConfigError, RunError
from shared.injection import Asked
from shared.links import GROUPS, directions_of
from shared.scenario import Inject
from tools.runs.injection import in_words_of, make
from tools.runs.injector_client import InjectorClient
from tools.verbs import Subparsers, add_run_dir, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "inject",
        """
        xrl up --injectable                                       # first
        xrl inject --link 'planner->joints' --delay 30 --jitter 10 --for 4
        xrl inject --link all --loss 0.2 --burst 5
        xrl inject --link 'planner->left' --partition --ordered --at 2 --for 1
        xrl inject --list
        xrl inject --clear
        """,
    )
    parser.add_argument(
        "--link",
        default="all",
        help=f"{', '.join(GROUPS)}, or one direction, such as 'planner->ankle_left', "
        "'knee_right->planner', 'harness->planner' (default: all)",
    )
    what = parser.add_argument_group("what is done to every message of it")
    what.add_argument("--delay", metavar="MS", help="so much later")
    what.add_argument(
        "--jitter", metavar="MS", help="uniform: +- so much; others: its standard deviation"
    )
    what.add_argument(
        "--distribution", choices=("uniform", "normal", "pareto"), help="of the jitter (uniform)"
    )
    what.add_argument("--loss", metavar="P", help="share that never comes, 0 to 1")
    what.add_argument("--burst", metavar="N", help="mean length of a row of losses (1: none)")
    what.add_argument("--duplicate", metavar="P", help="share that comes twice")
    what.add_argument("--reorder", metavar="P", help="share without delay: it overtakes the others")
    what.add_argument("--rate", metavar="BYTES", help="bytes a second that the line carries")
    what.add_argument("--partition", action="store_true", help="nothing passes")
    what.add_argument(
        "--ordered",
        action="store_true",
        help="as TCP: what is late holds up what is behind it, and comes in the end; without it, "
        "as datagrams: what is overtaken is lost",
    )
    when = parser.add_argument_group("when")
    when.add_argument("--at", type=float, default=0.0, metavar="T", help="in so many s (0: now)")
    when.add_argument(
        "--for", dest="lasts", metavar="S", help="for so long (until --clear, or the fleet's end)"
    )
    other = parser.add_argument_group("in place of that").add_mutually_exclusive_group()
    other.add_argument("--list", action="store_true", help="show what is done now")
    other.add_argument("--clear", action="store_true", help="end all that touches the link")
    add_run_dir(parser)


def run(args: argparse.Namespace) -> int:
    """Do it, or end it, and show what is done then."""
    console = Console()
    client = InjectorClient(args.run_dir)
    if args.list:
        show(client.list(), console)
        return 0
    if args.clear:
        directions_of(args.link)
        show(client.clear(args.link), console)
        return 0
    inject = inject_of(args)
    client.list()  # no fleet: said now, and not after --at
    if args.at:
        console.print(f"in {args.at:g} s: {in_words_of(inject)}")
        time.sleep(args.at)
    show(client.begin(inject), console)
    return 0


def inject_of(args: argparse.Namespace) -> Inject:
    """Return what the flags ask for.

    Raises:
        ConfigError: a number is out of its range, or they do not go together.
        RunError: --at is negative.
    """
    if not args.at >= 0.0:
        raise RunError(f"--at {args.at:g}: zero or more seconds from now")
    names = ("delay", "jitter", "distribution", "loss", "burst", "duplicate", "reorder", "rate")
    given = {name: getattr(args, name) for name in names} | {"for": args.lasts}
    words = [f"{name}={value}" for name, value in given.items() if value is not None]
    words += [name for name in ("partition", "ordered") if getattr(args, name)]
    try:
        return make(args.link, words)
    except ConfigError as error:
        raise RunError(f"{error.key}: {error.found}; {error.expected}") from None


def show(asked: Sequence[Asked], console: Console) -> None:
    """Print what is done, the newest last."""
    if not asked:
        console.print("nothing is done to any link")
        return
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("link", "what", "for", "passed", "lost"):
        table.add_column(heading, justify="right" if heading in ("passed", "lost") else "left")
    for row in asked:
        left = "until --clear" if row.left_s is None else f"{row.left_s:.1f} s more"
        table.add_row(row.link, row.detail, left, str(row.passed), str(row.lost))
    console.print(table)
