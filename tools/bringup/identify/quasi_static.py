"""Moments of a record in which the robot stood, or moved slowly: averages over a fifth of a second.

Pure: messages in, arrays out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from shared.arrays import Array
from shared.bus.messages import JointState, Mode, Wrench
from shared.clock import NS_PER_S

M = TypeVar("M")

SLOT_S: Final = 0.2
"""Time averaged into one moment: the motors' cogging and the encoders' noise go out of it."""
RATE_MAX: Final = 0.35
"""rad/s of a joint; faster is not quasi-static."""
ACCELERATION_MAX: Final = 1.0
"""rad/s^2 of a joint, from one slot to the next: 0.15 N m of a rotor, some 1 N m of a body."""
STATES_MIN: Final = 5
"""States of each module within a slot."""


class Moments(NamedTuple):
    """n moments."""

    t_s: Array
    """Middle of each (n,), s, on the streams' clock."""
    q: Array
    """Joint angles (n, 12), rad, as the services report them."""
    v: Array
    """Joint rates (n, 12), rad/s."""
    tau: Array
    """Joint torques asked of the drives (n, 12), N m."""
    force: Array
    """Force of the person on the torso (n, 3), N, torso axes, at the harness point."""
    moment: Array
    """(n, 3) N m about the harness point, torso axes."""


class TimedRows(NamedTuple, Generic[M]):
    """The messages of one key, with one clock's times for all streams."""

    t_ns: Sequence[int]
    rows: Sequence[M]


def moments_of(states: Sequence[TimedRows[JointState]], wrenches: TimedRows[Wrench]) -> Moments:
    """Return the quasi-static moments of a record; none if a stream is empty."""
    streams: tuple[TimedRows[Any], ...] = (*states, wrenches)
    begin = end = 0
    if all(len(stream.rows) for stream in streams):
        begin = max(stream.t_ns[0] for stream in streams)
        end = min(stream.t_ns[-1] for stream in streams)
    count = max(0, int((end - begin) / (SLOT_S * NS_PER_S)))
    good = np.ones(count, bool)
    q, v, tau = (np.zeros((count, 12)) for _ in range(3))
    felt = np.zeros((count, 6))
    for module, (t_ns, rows) in enumerate(states if count else ()):
        slots = _Slots(t_ns, begin, count)
        modes = np.array([row.mode for row in rows])
        changed = np.diff(modes, prepend=modes[:1]) != 0
        good &= slots.filled() & ~slots.any((modes != Mode.TRACK) | changed)
        columns = slice(2 * module, 2 * module + 2)
        for out, name in ((q, "q"), (v, "v"), (tau, "tau")):
            out[:, columns] = slots.means([getattr(row, name) for row in rows])
    if count:
        slots = _Slots(wrenches.t_ns, begin, count)
        invalid = np.array([not row.valid or row.saturated for row in wrenches.rows])
        good &= slots.filled() & ~slots.any(invalid)
        felt = slots.means([(*row.force, *row.moment) for row in wrenches.rows])
        change = np.abs(np.gradient(v, SLOT_S, axis=0)) if count > 1 else np.zeros_like(v)
        good &= (np.abs(v) < RATE_MAX).all(axis=1) & (change < ACCELERATION_MAX).all(axis=1)
    t_s = np.asarray(begin / NS_PER_S + SLOT_S * (0.5 + np.flatnonzero(good)), float)
    return Moments(t_s, q[good], v[good], tau[good], felt[good, :3], felt[good, 3:])


class _Slots:
    """In which of `count` slots from `begin` on each message of a stream lies."""

    def __init__(self, t_ns: Sequence[int], begin: int, count: int) -> None:
        slot = np.floor_divide(np.array(t_ns) - begin, round(SLOT_S * NS_PER_S))
        self._inside = (slot >= 0) & (slot < count)
        self._slot, self._count = slot[self._inside], count

    def _sums(self, weights: Array) -> Array:
        sums = np.bincount(self._slot, weights=weights[self._inside], minlength=self._count)
        return np.asarray(sums, float)

    def filled(self) -> NDArray[np.bool_]:
        return np.asarray(np.bincount(self._slot, minlength=self._count) >= STATES_MIN)

    def any(self, flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.asarray(self._sums(flags.astype(float)) > 0.0)

    def means(self, rows: Sequence[Sequence[float]]) -> Array:
        """Return the means (count, k) of rows (m, k) by slot."""
        values = np.array(rows)
        number = np.maximum(np.bincount(self._slot, minlength=self._count), 1)
        return np.stack([self._sums(column) / number for column in values.T], axis=1)
