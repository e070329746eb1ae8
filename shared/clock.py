"""The fleet's clock: CLOCK_MONOTONIC, shared by all processes of a host.

Laws never read it. If the cores are too slow for ten services in real time, a simulated fleet can
run in slow motion (`keep_pace`): the clock of all its processes runs slower, and control, physics
and log are as on a faster machine. Only code that waits uses the pace (`machine_s`, `sleep_until`).
"""

from __future__ import annotations

import time
from pathlib import Path

from shared.exceptions import FleetError
from shared.run_directory import live_dir

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
NS_PER_US = 1_000

PACE_FILE = "pace"
"""Name of a file in the live directory of a fleet in slow motion."""

_pace = 1.0


def now_ns() -> int:
    """Return the fleet's time in ns: one clock for all processes of one host.

    It counts whole microseconds, because stamps with random nanoseconds take a third more of a log.
    """
    now = time.monotonic_ns()
    return (now if _pace == 1.0 else int(now * _pace)) // NS_PER_US * NS_PER_US


def sleep_until(deadline_ns: int) -> None:
    """Sleep until a time of the fleet's clock; return at once if it has passed."""
    remaining_ns = deadline_ns - now_ns()
    if remaining_ns > 0:
        time.sleep(machine_s(remaining_ns / NS_PER_S))


def machine_s(fleet_s: float) -> float:
    """Convert seconds of the fleet's clock into seconds of the machine's, for waits."""
    return fleet_s / _pace


def pace() -> float:
    """Return the fleet's seconds per second of the machine."""
    return _pace


def keep_pace(run_dir: Path) -> None:
    """Use the clock of the fleet in a run directory; call this before any time is read.

    Raises FleetError if the file with its pace is malformed.
    """
    global _pace  # noqa: PLW0603 - a process has one clock, as it has one CLOCK_MONOTONIC
    path = live_dir(run_dir) / PACE_FILE
    try:
        text = path.read_text(encoding="ascii")
    except (FileNotFoundError, NotADirectoryError):
        _pace = 1.0
        return
    try:
        found = float(text)
    except ValueError:
        found = 0.0
    if not 0.0 < found <= 1.0:
        raise FleetError(
            f"{path}: {text.strip()!r} is not a valid pace; it must be above 0 and at most 1"
        )
    _pace = found
