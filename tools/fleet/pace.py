"""Slow motion: the pace of a simulated fleet's clock on cores that are too slow for real time."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, TypeVar

from shared.exceptions import FleetError
from shared.toml_file import Range
from tools.flags import Arg, Flags

T = TypeVar("T")

PACE_VARIABLE: Final = "XRL_PACE"
"""Environment variable: default pace of a simulated fleet."""
PACE_MIN: Final = 0.1
SLOWER: Final = 0.6
"""Factor on the pace when the cores are full."""
IDLE_LEAST: Final = 0.08
"""Below this idle fraction the cores count as full. A fleet in real time leaves about 0.25."""
WINDOW_S: Final = 5.0
"""Window of the idle fraction."""


class CoresFullError(FleetError):
    """The fleet does not come to track, and the cores have no time left."""


class PaceFlags(Flags):
    """How fast the clock of a simulated fleet goes."""

    pace: Annotated[
        float | None,
        Range(PACE_MIN, 1.0, ""),
        Arg(
            metavar="X",
            help="clock rate of a simulated fleet: 0.5 is slow motion at half speed, as on a "
            f"machine twice as fast (default: ${PACE_VARIABLE}, else 1; `demo` and `study crash` "
            f"lower it by {SLOWER:g} while the cores are full)",
        ),
    ] = None


def usual_pace() -> float:
    """Return the default pace."""
    text = os.environ.get(PACE_VARIABLE, "1")
    try:
        return float(text)
    except ValueError:
        raise FleetError(f"{PACE_VARIABLE}={text}: not a number; 1 is real time") from None


def check_pace(pace: float, *, simulated: bool) -> None:
    """Refuse a pace that cannot be kept."""
    if not PACE_MIN <= pace <= 1.0:
        raise FleetError(f"--pace {pace:g}: {PACE_MIN:g} to 1 is right")
    if pace != 1.0 and not simulated:
        raise FleetError(f"--pace {pace:g}: only a simulated fleet has slow motion; leave it out")


def run_at_fitting_pace(run: Callable[[float], T], tell: Callable[[str], None]) -> T:
    """Run at the default pace, and again at a slower one while the cores are full."""
    while True:
        pace = usual_pace()
        try:
            return run(pace)
        except CoresFullError as error:
            slower = round(SLOWER * pace, 2)
            if slower < PACE_MIN:
                raise
            os.environ[PACE_VARIABLE] = f"{slower:g}"
            tell(f"{error}; starting again in slow motion, at {slower:g}")


class IdleMeter:
    """Idle fraction of all cores over the last `WINDOW_S`."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, int, int]] = deque()
        self.sample()

    def sample(self) -> float | None:
        """Sample; return the idle fraction, or None until the window is full."""
        now_s = time.monotonic()
        self._samples.append((now_s, *idle_and_total()))
        while len(self._samples) > 1 and now_s - self._samples[1][0] >= WINDOW_S:
            self._samples.popleft()
        begin_s, *before = self._samples[0]
        return None if now_s - begin_s < WINDOW_S else idle_share((before[0], before[1]))


def idle_share(before: tuple[int, int]) -> float:
    """Return the idle fraction of all cores since `idle_and_total()` returned `before`."""
    (idle, total), (idle_now, total_now) = before, idle_and_total()
    return (idle_now - idle) / max(1, total_now - total)


def idle_and_total() -> tuple[int, int]:
    """Return the idle and all ticks of every core since the machine started.

    What is niced counts as idle: it gives way to a fleet that is not.
    """
    fields = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:]
    ticks = [int(field) for field in fields]
    niced = ticks[1] if os.nice(0) == 0 else 0
    return niced + ticks[3] + ticks[4], sum(ticks)
