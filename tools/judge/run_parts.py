"""Which part of a run a command reads: `--from` and `--to`, on the time axis of the report."""

from __future__ import annotations

import argparse
import math
from typing import Final

from shared.exceptions import RunError
from tools.judge import verdict
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, RunPart, parts_of, read_part
from tools.number_arguments import finite

_LOOK_S: Final = 20.0
"""Length of the parts in which the scenario's start is looked for."""


def add_part(parser: argparse.ArgumentParser, what: str = "of the part to read") -> None:
    """Add `--from` and `--to`."""
    for flag, name, default in (("--from", "begin", -math.inf), ("--to", "end", math.inf)):
        parser.add_argument(
            flag,
            dest=f"{name}_s",
            type=finite,
            default=default,
            metavar="S",
            help=f"{name} {what} (default: the run's): scenario time, or time since "
            "the log begins if it has no scenario; as in the report",
        )


def part_of(args: argparse.Namespace, index: RunIndex) -> RunPart:
    """Return the part that a command line asks for."""
    begin_s, end_s = args.begin_s, args.end_s
    if math.isinf(begin_s) and math.isinf(end_s):
        return RunPart()
    if not begin_s < end_s:
        raise RunError(f"--from {begin_s:g} --to {end_s:g}: the first is to be the smaller one")
    offset_s = (zero_ns(index) - index.span_ns[0]) / 1e9
    first_s, last_s = -offset_s, index.length_s - offset_s
    if begin_s > last_s or end_s < first_s:
        raise RunError(
            f"{index.path}: has nothing from {begin_s:g} to {end_s:g} s; it holds "
            f"{first_s:.2f} to {last_s:.2f} s"
        )
    return RunPart(max(0.0, begin_s + offset_s), end_s + offset_s)


def read_asked(args: argparse.Namespace, index: RunIndex, *, as_sent: bool = False) -> RunLog:
    """Read the part that a command line asks for, at once; `as_sent` as for `RunLog`."""
    return read_part(index, part_of(args, index), as_sent=as_sent)


def zero_ns(index: RunIndex) -> int:
    """Return time zero of a run, monotonic: the scenario's start, or the log's first message."""
    for part in parts_of(index, part_s=_LOOK_S, margin_s=0.0):
        try:
            return verdict.course(part).zero_ns
        except RunError:
            if not part.has_world:
                break
    return index.span_ns[0]
