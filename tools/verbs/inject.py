"""`xrl inject`: impairs the network of a live fleet."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Annotated, Final

from rich import box
from rich.table import Table

from shared.config.scenarios import Inject
from shared.exceptions import ConfigError
from shared.links import GROUPS
from shared.network.proxy_protocol import RequestedImpairment
from tools.flags import Arg, RunDirFlags, parsed, positional
from tools.fleet.proxy_client import ProxyClient
from tools.live.describe_inject import check_link, parse_inject
from tools.terminal import Console

RULE: Final = "if a link has several impairments, a partition applies, else the one that began last"

ABOUT: Final = f"""
LINK is {", ".join(GROUPS)},
or one direction, such as 'planner->ankle_left' or 'harness->planner'. The words are:
  delay=TIME         30, 30ms, 0.03s or 500us
  jitter=TIME        half the width if uniform, else the standard deviation; a delay is at least 0
  distribution=KIND  of the jitter: uniform (default), normal, pareto
  loss=SHARE         probability of loss, 0.2 or 20%; 1 is every message
  burst=N            mean number of losses in a row (1)
  duplicate=SHARE    share of messages that arrive twice
  reorder=SHARE      share of messages without delay, which overtake others
  rate=BYTES         capacity, bytes (not bits) per second
  partition          no message passes
  ordered            stream: a late message delays those behind it, a partition holds messages back,
                     and lost messages are not resent. Without it, datagrams: a message that is
                     overtaken or meets a partition is lost
  at=T, for=T        start T seconds from now (0); duration (until --clear or the fleet's end)
Messages sent together are one Zenoh batch, which is delayed or lost as a whole.
{RULE[0].upper()}{RULE[1:]};
when it ends, this rule selects the next one.
"""
EXAMPLES: Final = """
xrl up --injectable                                       # required first
xrl inject 'planner->joints delay=30ms jitter=10ms for=4'
xrl inject 'all loss=20% burst=5'
xrl inject 'planner->left partition ordered at=2 for=1'
xrl inject --list
xrl inject --clear all
"""


def _link(text: str) -> str:
    try:
        check_link(text)
    except ConfigError as error:
        raise argparse.ArgumentTypeError(f"{error.found}; {error.expected}") from None
    return text


class InjectFlags(RunDirFlags):
    """Impairment to start, list or end."""

    words: Annotated[
        Inject | None, positional("'LINK KEY=VALUE ...'", parse=parse_inject, one_of="what")
    ] = None
    """link and its impairment"""
    list: Annotated[bool, Arg(one_of="what")] = False
    """list active and planned impairments"""
    clear: Annotated[str | None, parsed(_link, "LINK", one_of="what")] = None
    """end every impairment that affects this link, also on the impairment's other links"""


def run(flags: InjectFlags) -> int:
    """Start or end an impairment, and show active and planned ones."""
    console = Console()
    client = ProxyClient(flags.run_dir)
    if flags.words is not None:
        show(client.begin(flags.words, flags.words.at), console)
    elif flags.clear is not None:
        _clear(client, flags.clear, console)
    else:
        show(client.list(), console)
    return 0


def _clear(client: ProxyClient, link: str, console: Console) -> None:
    """End the impairments of a link; show them and those that remain."""
    before = client.list()
    left = client.clear(link)
    numbers = {row.number for row in left}
    for row in before:
        if row.number not in numbers:
            counts = f"{row.passed} passed, {row.lost} lost"
            console.print(f"ended: {row.link} {row.detail}; {counts}", highlight=False)
    show(left, console)


def show(asked: Sequence[RequestedImpairment], console: Console) -> None:
    """Print active and planned impairments, the newest last."""
    if not asked:
        console.print("no link is impaired")
        return
    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("link", "impairment", "in force", "for", "passed", "lost"):
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
