"""`xrl inject`: make the network of a live fleet bad, on purpose and for a while."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Final

from rich import box
from rich.table import Table

from shared.config.scenarios import Inject
from shared.exceptions import ConfigError, RunError
from shared.links import GROUPS
from shared.network.proxy_protocol import RequestedImpairment
from tools.fleet.proxy_client import ProxyClient
from tools.live.describe_inject import (
    DISTRIBUTION,
    NUMBERS,
    SWITCHES,
    check_link,
    make,
    parse_inject,
)
from tools.terminal import Console
from tools.verb_table import Subparsers, add_run_dir, add_verb

ALL: Final = "all"
WORDS: Final = "'LINK KEY=VALUE ...'"
RULE: Final = "of several on one link, a partition counts first, else what began last"


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "inject",
        """
        xrl up --injectable                                       # first
        xrl inject --link 'planner->joints' --delay 30ms --jitter 10ms --for 4
        xrl inject --link all --loss 20% --burst 5
        xrl inject --link 'planner->left' --partition --ordered --at 2 --for 1
        xrl inject 'planner->joints delay=30 jitter=10 for=4'     # as --inject of demo and sim
        xrl inject --list
        xrl inject --clear
        """,
    )
    parser.add_argument(
        "words",
        nargs="?",
        metavar=WORDS,
        help="all of it in words, in place of flags: as --inject of demo and sim, but `at` is from "
        "now",
    )
    parser.add_argument(
        "--link",
        help=f"{', '.join(GROUPS)}, or one direction, such as 'planner->ankle_left', "
        f"'knee_right->planner', 'harness->planner' (default: {ALL})",
    )
    what = parser.add_argument_group(
        "what is done to every message of it",
        "A message is a batch of Zenoh's here: what is sent at once travels, and is lost, as one.\n"
        "TIME: 30, 30ms, 0.03s or 500us. SHARE: a probability, 0.2 or 20%.\n"
        f"{RULE[0].upper()}{RULE[1:]};\nwhen that is over, the others count again.",
    )
    what.add_argument("--delay", metavar="TIME", help="delay of each message")
    what.add_argument(
        "--jitter",
        metavar="TIME",
        help="half the width if uniform, else the standard deviation; a message that this would "
        "deliver before it is sent has no delay",
    )
    what.add_argument(
        "--distribution", metavar="KIND", help="of the jitter: uniform (default), normal, pareto"
    )
    what.add_argument("--loss", metavar="SHARE", help="messages lost; 1 is all, and not 1%%")
    what.add_argument("--burst", metavar="N", help="mean number of losses in a row (1)")
    what.add_argument("--duplicate", metavar="SHARE", help="messages that arrive twice")
    what.add_argument("--reorder", metavar="SHARE", help="messages without delay")
    what.add_argument("--rate", metavar="BYTES", help="bytes (not bits) a second on the line")
    what.add_argument("--partition", action="store_true", help="nothing passes")
    what.add_argument(
        "--ordered",
        action="store_true",
        help="as on a stream: a late message delays those behind it, and a partition holds all "
        "back until its end; --loss still loses messages, nothing is sent again. Without it, as "
        "datagrams: an overtaken message, or one in a partition, is lost",
    )
    when = parser.add_argument_group("when")
    when.add_argument("--at", metavar="T", help="start in T seconds from now (default: 0)")
    when.add_argument(
        "--for",
        metavar="T",
        help="duration in seconds (default: until --clear, or the fleet's end)",
    )
    other = parser.add_argument_group("in place of that").add_mutually_exclusive_group()
    other.add_argument("--list", action="store_true", help="list active and planned impairments")
    other.add_argument(
        "--clear",
        action="store_true",
        help="end what touches the link: wholly, on its other directions too",
    )
    add_run_dir(parser)


def run(args: argparse.Namespace) -> int:
    """Start or end an impairment, and show those that are active."""
    console = Console()
    client = ProxyClient(args.run_dir)
    if args.list:
        _refuse(args, "--list", "link", "words")
        show(client.list(), console)
    elif args.clear:
        _refuse(args, "--clear", "words")
        _clear(client, args.link or ALL, console)
    else:
        inject = inject_of(args)
        show(client.begin(inject, inject.at), console)
    return 0


def _clear(client: ProxyClient, link: str, console: Console) -> None:
    """End the impairments of a link; show them and those that remain."""
    try:
        check_link(link, "--")
    except ConfigError as error:
        raise RunError(f"{error.key}: {error.found}; {error.expected}") from None
    before = client.list()
    left = client.clear(link)
    numbers = {row.number for row in left}
    for row in before:
        if row.number not in numbers:
            counts = f"{row.passed} passed, {row.lost} lost"
            console.print(f"ended: {row.link} {row.detail}; {counts}", highlight=False)
    show(left, console)


def inject_of(args: argparse.Namespace) -> Inject:
    """Return the requested impairment; its `at` counts from now.

    Raises:
        RunError: a flag is malformed or out of its range, or two contradict each other.
    """
    if args.words is not None:
        _refuse(args, WORDS, "link")
        try:
            return parse_inject(args.words)
        except argparse.ArgumentTypeError as error:
            raise RunError(str(error)) from None
    try:
        return make(args.link or ALL, _given(args), dash="--")
    except ConfigError as error:
        raise RunError(f"{error.key}: {error.found}; {error.expected}") from None


def _given(args: argparse.Namespace) -> dict[str, str]:
    """Return the words that were given, with their values."""
    given = {word: getattr(args, word) for word in (*NUMBERS, DISTRIBUTION, *SWITCHES)}
    return {word: value for word, value in given.items() if value not in (None, False)}


def _refuse(args: argparse.Namespace, flag: str, *others: str) -> None:
    """Refuse flags that would have no effect.

    Raises:
        RunError: such a flag was given.
    """
    given = [f"--{word}" for word in _given(args)]
    given += [
        "--link" if word == "link" else WORDS for word in others if getattr(args, word) is not None
    ]
    if given:
        words = ", ".join(given)
        raise RunError(f"{flag} with {words}: without effect; leave one of them out")


def show(asked: Sequence[RequestedImpairment], console: Console) -> None:
    """Print active and planned impairments, the newest last."""
    if not asked:
        console.print("nothing is done to any link")
        return
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("link", "what", "in force", "for", "passed", "lost"):
        table.add_column(heading, justify="right" if heading in ("passed", "lost") else "left")
    for row in asked:
        left = "until --clear"
        if row.left_s is not None:
            left = f"{row.left_s - row.in_s:.1f} s{'' if row.in_s else ' more'}"
        counts = (str(row.passed), str(row.lost))
        table.add_row(row.link, row.detail, row.standing() or "yes", left, *counts)
    console.print(table)
    if any(row.hidden for row in asked):
        console.print(f"hidden: {RULE}")
