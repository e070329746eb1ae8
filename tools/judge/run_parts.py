"""Part of a run that a command reads: `--from` and `--to`, on the time axis of the report."""

from __future__ import annotations

import math
from typing import Annotated, Final

from shared.exceptions import RunError
from tools.flags import Flags, Number, option
from tools.judge import verdict
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, RunPart, parts_of, read_part

_LOOK_S: Final = 20.0
"""Length of the parts in which the scenario's start is searched for, s."""


class PartFlags(Flags):
    """Part of a run; by default all of it."""

    begin_s: Annotated[Number, option("--from", metavar="S")] = -math.inf
    """start: scenario time, or time since the log's start if it has no scenario (default: the run's
    start)"""
    end_s: Annotated[Number, option("--to", metavar="S")] = math.inf
    """end (default: the run's end)"""

    def check(self) -> None:
        """Refuse an empty part."""
        super().check()
        if not self.begin_s < self.end_s:
            raise RunError(
                f"--from {self.begin_s:g} --to {self.end_s:g}: --from must be less than --to"
            )


def part_of(flags: PartFlags, index: RunIndex) -> RunPart:
    """Return the part that a command line requests."""
    begin_s, end_s = flags.begin_s, flags.end_s
    if math.isinf(begin_s) and math.isinf(end_s):
        return RunPart()
    offset_s = (zero_ns(index) - index.span_ns[0]) / 1e9
    first_s, last_s = 0.0 - offset_s, index.length_s - offset_s  # no -0
    if begin_s > last_s or end_s < first_s:
        asked = f"after {begin_s:g}" if begin_s > last_s else f"before {end_s:g}"
        raise RunError(
            f"{index.path}: has nothing {asked} s; it covers {first_s:.2f} to {last_s:.2f} s"
        )
    return RunPart(max(0.0, begin_s + offset_s), end_s + offset_s)


def read_asked(flags: PartFlags, index: RunIndex, *, as_sent: bool = False) -> RunLog:
    """Read the part that a command line requests, all at once; `as_sent` as for `RunLog`."""
    return read_part(index, part_of(flags, index), as_sent=as_sent)


def zero_ns(index: RunIndex) -> int:
    """Return time zero of a run, monotonic: that of `verdict.course`, else the first message."""
    for part in parts_of(index, part_s=_LOOK_S, margin_s=0.0):
        try:
            return verdict.course(part).zero_ns
        except RunError:
            if not part.has_world:
                break
    return index.span_ns[0]
