"""Slow motion: a slower clock for a simulated fleet whose cores are too slow for real time."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, TypeVar

from shared.exceptions import FleetError
from shared.toml_file import Range
from tools.flags import Arg, Flags

T = TypeVar("T")

PACE_VARIABLE: Final = "XRL_PACE"
"""Environment variable with the default pace of a simulated fleet."""
PACE_MIN: Final = 0.1
SLOWER: Final = 0.6
"""Factor on the pace if the cores are full."""
IDLE_LEAST: Final = 0.08
"""The cores count as full below this idle fraction, while the robot stands before the scenario.
A fleet in real time leaves about 0.25."""


class CoresFullError(FleetError):
    """The cores are full while the robot stands or stands up."""


class PaceFlags(Flags):
    """Clock rate of a simulated fleet."""

    pace: Annotated[
        float | None,
        Range(PACE_MIN, 1.0, ""),
        Arg(
            metavar="X",
            help="clock rate of a simulated fleet: 0.5 is half speed "
            f"(default: ${PACE_VARIABLE}, else 1; if the cores are full before the scenario "
            f"starts, `demo` and `study crash` restart at {SLOWER:g} times this default)",
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
    """Refuse a pace that is out of range, or not 1 on a real robot."""
    if not PACE_MIN <= pace <= 1.0:
        raise FleetError(f"--pace {pace:g}: must be between {PACE_MIN:g} and 1")
    if pace != 1.0 and not simulated:
        raise FleetError(
            f"--pace {pace:g}: only a simulated fleet can run in slow motion; remove --pace"
        )


def run_at_fitting_pace(run: Callable[[float], T], tell: Callable[[str], None]) -> T:
    """Run at the default pace; restart at a slower one as long as the cores are full."""
    while True:
        pace = usual_pace()
        try:
            return run(pace)
        except CoresFullError as error:
            slower = round(SLOWER * pace, 2)
            if slower < PACE_MIN:
                raise
            os.environ[PACE_VARIABLE] = f"{slower:g}"
            tell(f"{error}; restarting in slow motion, at {slower:g}")


def idle_share(before: tuple[int, int]) -> float:
    """Return the idle fraction of all cores since `idle_and_total()` returned `before`."""
    (idle, total), (idle_now, total_now) = before, idle_and_total()
    return (idle_now - idle) / max(1, total_now - total)


def idle_and_total() -> tuple[int, int]:
    """Return the idle ticks and all ticks of every core since the machine started.

    Time of niced processes counts as idle, because they yield to a fleet that is not niced.
    """
    fields = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:]
    ticks = [int(field) for field in fields]
    niced = ticks[1] if os.nice(0) == 0 else 0
    return niced + ticks[3] + ticks[4], sum(ticks)
