"""Moments of a record in which the robot stood, or moved slowly: averages over a fifth of a second.

Pure: messages in, arrays out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from shared.bus.messages import JointState, Mode, Wrench
from shared.clock import NS_PER_S

Array = NDArray[np.float64]
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
    if not all(len(stream.rows) for stream in streams):
        return _moments(*(np.zeros((0, k)) for k in (1, 12, 12, 12, 6)))
    begin = max(stream.t_ns[0] for stream in streams)
    end = min(stream.t_ns[-1] for stream in streams)
    count = max(0, int((end - begin) / (SLOT_S * NS_PER_S)))
    good = np.ones(count, bool)
    q, v, tau = (np.zeros((count, 12)) for _ in range(3))
    for module, (t_ns, rows) in enumerate(states):
        slot = _slot_of(np.array(t_ns), begin)
        stands = np.array([row.mode == Mode.TRACK for row in rows])
        good &= _filled(slot, count) & ~_any(~stands, slot, count)
        columns = slice(2 * module, 2 * module + 2)
        for out, name in ((q, "q"), (v, "v"), (tau, "tau")):
            out[:, columns] = _means(np.array([getattr(row, name) for row in rows]), slot, count)
        modes = np.array([row.mode for row in rows])
        good &= ~_any(np.diff(modes, prepend=modes[:1]) != 0, slot, count)
    slot = _slot_of(np.array(wrenches.t_ns), begin)
    valid = np.array([row.valid and not row.saturated for row in wrenches.rows])
    good &= _filled(slot, count) & ~_any(~valid, slot, count)
    felt = np.array([(*row.force, *row.moment) for row in wrenches.rows])
    wrench = _means(felt, slot, count)
    if count:
        change = np.abs(np.gradient(v, SLOT_S, axis=0)) if count > 1 else np.zeros_like(v)
        good &= (np.abs(v) < RATE_MAX).all(axis=1) & (change < ACCELERATION_MAX).all(axis=1)
    t_s = begin / NS_PER_S + SLOT_S * (0.5 + np.flatnonzero(good))
    return _moments(np.asarray(t_s, float)[:, None], q[good], v[good], tau[good], wrench[good])


def _moments(t_s: Array, q: Array, v: Array, tau: Array, wrench: Array) -> Moments:
    return Moments(t_s[:, 0], q, v, tau, wrench[:, :3], wrench[:, 3:])


def _slot_of(t_ns: NDArray[np.int64], begin: int) -> NDArray[np.int64]:
    return np.floor_divide(t_ns - begin, round(SLOT_S * NS_PER_S))


def _inside(slot: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    return (slot >= 0) & (slot < count)


def _filled(slot: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    inside = slot[_inside(slot, count)]
    return np.asarray(np.bincount(inside, minlength=count) >= STATES_MIN)


def _any(flags: NDArray[np.bool_], slot: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
    chosen = _inside(slot, count) & flags
    return np.asarray(np.bincount(slot[chosen], minlength=count) > 0)


def _means(values: Array, slot: NDArray[np.int64], count: int) -> Array:
    """Return the means (count, k) of values (m, k) by slot."""
    chosen = _inside(slot, count)
    number = np.maximum(np.bincount(slot[chosen], minlength=count), 1)
    columns = [
        np.bincount(slot[chosen], weights=values[chosen, k], minlength=count) / number
        for k in range(values.shape[1])
    ]
    return np.stack(columns, axis=1)
