"""How fast the clock of a simulated fleet goes, on cores that may not carry it in real time."""

from __future__ import annotations

import argparse
import os
import time
from collections import deque
from pathlib import Path
from typing import Final

from shared.exceptions import FleetError

PACE_VARIABLE: Final = "XRL_PACE"
"""Environment variable: the pace at which fleets are started where none is asked for."""
PACE_MIN: Final = 0.1
SLOWER: Final = 0.7
"""A fleet that the cores do not carry is started again at so much of its pace."""
IDLE_LEAST: Final = 0.08
"""Share of all cores: with less of it idle they are full. A fleet that is carried leaves a
quarter."""
WINDOW_S: Final = 5.0
"""The share is taken over so long."""


class CoresFullError(FleetError):
    """The fleet does not come to track, and the cores have no time left."""


def add_pace(parser: argparse.ArgumentParser) -> None:
    """Add `--pace`."""
    parser.add_argument(
        "--pace",
        type=float,
        metavar="X",
        help="how fast the simulated fleet's clock goes: 0.5 is slow motion at half speed, in "
        "which all is as in real time on a machine twice as fast (default: "
        f"${PACE_VARIABLE}, else 1, and where the cores do not carry that {SLOWER:g} of it)",
    )


def usual_pace() -> float:
    """Return the pace of fleets for which none is asked."""
    text = os.environ.get(PACE_VARIABLE, "1")
    try:
        return float(text)
    except ValueError:
        raise FleetError(f"{PACE_VARIABLE}={text}: no number; 1 is real time") from None


def check_pace(pace: float, *, simulated: bool) -> None:
    """Refuse a pace that cannot be kept.

    Raises:
        FleetError: it is out of range, or the drives are real and know no slow motion.
    """
    if not PACE_MIN <= pace <= 1.0:
        raise FleetError(f"--pace {pace:g}: {PACE_MIN:g} to 1 is right")
    if pace != 1.0 and not simulated:
        raise FleetError(f"--pace {pace:g}: only a simulated fleet has slow motion; leave it out")


class IdleMeter:
    """Share of the cores that was idle in the last `WINDOW_S`."""

    def __init__(self) -> None:
        """Begin to look."""
        self._looks: deque[tuple[float, int, int]] = deque()
        self.look()

    def look(self) -> float | None:
        """Look again; return the share, or None before the window is full."""
        now_s = time.monotonic()
        self._looks.append((now_s, *idle_and_total()))
        while len(self._looks) > 1 and now_s - self._looks[1][0] >= WINDOW_S:
            self._looks.popleft()
        (begin_s, idle, total), (_, idle_now, total_now) = self._looks[0], self._looks[-1]
        if now_s - begin_s < WINDOW_S or total_now == total:
            return None
        return (idle_now - idle) / (total_now - total)


def idle_and_total() -> tuple[int, int]:
    """Return the idle and all ticks of every core since the machine started."""
    fields = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:]
    ticks = [int(field) for field in fields]
    return ticks[3] + ticks[4], sum(ticks)
