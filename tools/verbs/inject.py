"""`xrl inject`: make the network of a live fleet bad, on purpose and for a while."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Annotated, Final

from rich import box
from rich.table import Table

from shared.config.scenarios import Inject
from shared.exceptions import ConfigError, RunError
from shared.links import GROUPS
from shared.network.proxy_protocol import RequestedImpairment
from tools.flags import Arg, RunDirFlags, positional
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

ALL: Final = "all"
WORDS: Final = "'LINK KEY=VALUE ...'"
RULE: Final = "of several on one link, a partition applies first, else the one that began last"

_WHAT: Final = f"""what happens to every message on the link
A message here is a batch of Zenoh's: messages sent together travel, and are lost, together.
TIME: 30, 30ms, 0.03s or 500us. SHARE: a probability, 0.2 or 20%.
{RULE[0].upper()}{RULE[1:]};
when that ends, the others apply again."""

EXAMPLES: Final = """
xrl up --injectable                                       # first
xrl inject --link 'planner->joints' --delay 30ms --jitter 10ms --for 4
xrl inject --link all --loss 20% --burst 5
xrl inject --link 'planner->left' --partition --ordered --at 2 --for 1
xrl inject 'planner->joints delay=30 jitter=10 for=4'     # same words as --inject of demo and sim
xrl inject --list
xrl inject --clear
"""


class InjectFlags(RunDirFlags):
    """A link, and what is done to it; each value is read as in the words of a scenario."""

    words: Annotated[str | None, positional(WORDS)] = None
    """everything as one string instead of flags, as --inject of demo and sim; `at` counts from
    now"""
    link: Annotated[
        str | None,
        Arg(
            metavar="LINK",
            help=f"{', '.join(GROUPS)}, or one direction, such as 'planner->ankle_left', "
            f"'knee_right->planner', 'harness->planner' (default: {ALL})",
        ),
    ] = None
    delay: Annotated[str | None, Arg(metavar="TIME", group=_WHAT)] = None
    """delay of each message"""
    jitter: Annotated[str | None, Arg(metavar="TIME", group=_WHAT)] = None
    """half the width if uniform, else the standard deviation; a message that this would deliver
    before it is sent has no delay"""
    distribution: Annotated[str | None, Arg(metavar="KIND", group=_WHAT)] = None
    """of the jitter: uniform (default), normal, pareto"""
    loss: Annotated[str | None, Arg(metavar="SHARE", group=_WHAT)] = None
    """messages lost; 1 is all, and not 1%"""
    burst: Annotated[str | None, Arg(metavar="N", group=_WHAT)] = None
    """mean number of losses in a row (1)"""
    duplicate: Annotated[str | None, Arg(metavar="SHARE", group=_WHAT)] = None
    """messages that arrive twice"""
    reorder: Annotated[str | None, Arg(metavar="SHARE", group=_WHAT)] = None
    """messages without delay"""
    rate: Annotated[str | None, Arg(metavar="BYTES", group=_WHAT)] = None
    """bytes (not bits) a second on the line"""
    partition: Annotated[bool, Arg(group=_WHAT)] = False
    """nothing passes"""
    ordered: Annotated[bool, Arg(group=_WHAT)] = False
    """behave like a stream: a late message delays those behind it, and a partition holds all back
    until its end; --loss still loses messages, and nothing is resent. Without it the link behaves
    like datagrams: an overtaken message, or one in a partition, is lost"""
    at: Annotated[str | None, Arg(metavar="T", group="when")] = None
    """start in T seconds from now (default: 0)"""
    for_: Annotated[str | None, Arg(metavar="T", group="when")] = None
    """duration in seconds (default: until --clear, or the fleet's end)"""
    list: Annotated[bool, Arg(group="in place of that", exclusive="other")] = False
    """list active and planned impairments"""
    clear: Annotated[bool, Arg(group="in place of that", exclusive="other")] = False
    """end every impairment that touches the link, in all of its directions"""

    @property
    def given(self) -> dict[str, str]:
        """The words of what is done, with their values."""
        names = (*NUMBERS, DISTRIBUTION, *SWITCHES)
        found = {name: getattr(self, "for_" if name == "for" else name) for name in names}
        return {name: value for name, value in found.items() if value not in (None, False)}

    def check(self) -> None:
        """Refuse values that are not understood, and flags that do not go together."""
        super().check()
        flags = [f"--{word}" for word in self.given]
        if self.link is not None and not self.clear:
            flags.append("--link")
        other = "--list" if self.list else "--clear" if self.clear else ""
        without = flags if self.words is None else [*flags, WORDS]
        if other and without:
            names = ", ".join(without)
            raise RunError(f"{other} with {names}: without effect; leave one of them out")
        if self.words is not None and flags:
            names = ", ".join(flags)
            right = "write everything in the words ('all loss=20% for=5'), or everything as flags"
            raise RunError(f"{WORDS} with {names}: {right}")
        if not other:
            _inject_of(self)


def run(flags: InjectFlags) -> int:
    """Start or end an impairment, and show those that are active."""
    console = Console()
    client = ProxyClient(flags.run_dir)
    if flags.list:
        show(client.list(), console)
    elif flags.clear:
        _clear(client, flags.link or ALL, console)
    else:
        inject = _inject_of(flags)
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


def _inject_of(flags: InjectFlags) -> Inject:
    """Return the requested impairment; its `at` counts from now."""
    if flags.words is not None:
        try:
            return parse_inject(flags.words)
        except argparse.ArgumentTypeError as error:
            raise RunError(str(error)) from None
    try:
        return make(flags.link or ALL, flags.given, dash="--")
    except ConfigError as error:
        raise RunError(f"{error.key}: {error.found}; {error.expected}") from None


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
