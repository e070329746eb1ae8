"""An idle real-time thread beside the live tests: what delays it is the machine, and no test.

Run as a program it writes a line for each gap: when it ended and how long it was, monotonic ns.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

PERIOD_NS: Final = 2_000_000
GAP_NS: Final = 20_000_000
"""A delay beyond the period that counts: with some milliseconds of network, an age of 50 ms."""
PRIORITY: Final = 90
"""Above every service (`shared.scheduling`)."""


class Gap(NamedTuple):
    """Time in which the machine ran nothing."""

    end_ns: int
    lasted_ns: int


def gaps_in(path: Path, from_ns: int = 0) -> list[Gap]:
    """Return what was written, from a time on; a last line that is not whole is left out."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    found = [Gap(*map(int, line.split())) for line in lines if line.endswith("\n")]
    return [gap for gap in found if gap.end_ns >= from_ns]


def watch(path: Path) -> None:
    """Write gaps until the process that started this one is no more."""
    with suppress(PermissionError):  # without it a busy machine is taken for one that stalls, too
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    parent = os.getppid()
    with path.open("a", encoding="utf-8", buffering=1) as file:
        last_ns = time.monotonic_ns()
        while os.getppid() == parent:
            time.sleep(PERIOD_NS / 1e9)
            now_ns = time.monotonic_ns()
            if now_ns - last_ns > PERIOD_NS + GAP_NS:
                file.write(f"{now_ns} {now_ns - last_ns - PERIOD_NS}\n")
            last_ns = now_ns


if __name__ == "__main__":
    watch(Path(sys.argv[1]))
