"""Watches legs swing that somebody has pushed: does each hang free, and where does it rest?"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from services.joint.differential import joint_from_motor
from services.joint.drivers.base import Drive, DriveStatus
from shared.bus.messages import Pair
from shared.exceptions import DriveError
from shared.joints import kind_of
from tools.bringup.free_leg import not_swung
from tools.bringup.motion_runner import STILL, STILL_FOR_S

HOW: Final = (
    "push the foot of each leg forward and to its right, so that knee and hip move, and let go: "
    "it has to swing back past where it rests by itself, and to come to rest"
)
WAIT_S: Final = 180.0
PROGRESS_S: Final = 1.0
_READ_S: Final = 0.005

Swing = tuple[Pair, Pair]
"""Lowest and highest (phi, theta), from where the joint rests, rad."""


class _Track(NamedTuple):
    """Where a joint has been, by the drive's own count, rad."""

    now: Pair
    low: Pair
    high: Pair
    still_at: Pair
    still_since: float

    def moved_to(self, q: Pair, now_s: float) -> _Track:
        """Return the track with another position."""
        low = (min(q[0], self.low[0]), min(q[1], self.low[1]))
        high = (max(q[0], self.high[0]), max(q[1], self.high[1]))
        if max(abs(q[0] - self.still_at[0]), abs(q[1] - self.still_at[1])) > STILL:
            return _Track(q, low, high, q, now_s)
        return _Track(q, low, high, self.still_at, self.still_since)

    @property
    def swing(self) -> Swing:
        """What came of it, from where it is now."""
        (a, b), (low_a, low_b), (high_a, high_b) = self.now, self.low, self.high
        return (low_a - a, low_b - b), (high_a - a, high_b - b)


def watch(
    drives: Mapping[str, Drive],
    gear_ratio: float,
    progress: Callable[[str], None],
    clock: Callable[[], float] = time.monotonic,
) -> dict[str, Swing]:
    """Return how knees and hips have swung once all have and rest again, or after `WAIT_S`.

    Args:
        drives: by module, idle, in their own counts.
        gear_ratio: N of the differential.
        progress: takes what is missing, once a second.
        clock: s.

    Raises:
        DriveError: a drive has gone silent or is armed.
    """
    tracks: dict[str, _Track] = {}
    begun, told = clock(), clock()
    while clock() - begun < WAIT_S:
        for module, drive in drives.items():
            reading = drive.read(_READ_S)
            if reading is None:
                continue
            if reading.status in (DriveStatus.LOST, DriveStatus.ARMED):
                raise DriveError(f"{module}: {reading.status.name} while its leg swings")
            q, now = joint_from_motor(reading.pos_turns, gear_ratio), clock()
            track = tracks.get(module) or _Track(q, q, q, q, now)
            tracks[module] = track.moved_to(q, now)
        missing = _missing(tracks, clock())
        if len(tracks) == len(drives) and not missing:
            break
        if clock() - told > PROGRESS_S and missing:
            told = clock()
            progress("; ".join(missing))
    return {module: track.swing for module, track in tracks.items()}


def _missing(tracks: Mapping[str, _Track], now_s: float) -> list[str]:
    """Return which joints have not swung yet, or do not rest."""
    found = []
    for module, track in tracks.items():
        side = not_swung(track.swing, knee=kind_of(module) == "knee")
        if side:
            found.append(f"{module}: {side}")
        elif now_s - track.still_since < STILL_FOR_S:
            found.append(f"{module}: not at rest")
    return found
