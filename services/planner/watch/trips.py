"""The planner's trips. Pure.

A trip makes all six modules hold. No single joint service can detect these faults
(`shared.robot.trip_table`; limits: [trips] of the robot file):

    legs       the two legs' estimates of the torso's position differ: a sole tips, or a zero is off
    reach      the inverse kinematics does not reach the reference pose
    tracking   a joint is far from its reference
    unloaded   a sole bears almost no load (`services.planner.law.feet.Soles`)
    sinking    the COM sinks or rises faster than a person leads
    turning    the torso turns faster than a person leads
    harness    the force on the person differs from the request by too much
    sagging    the person presses the robot down harder than a lead does: power of the load beyond
               assist and lead, while it sinks
    unattended the robot drifts without a hand on it (`services.planner.watch.unattended`)
    edge       a sole's centre of pressure is near its edge (`services.planner.law.feet.Soles`)
    tipping    a sole's centre of pressure is at its edge; the delay is shorter than that of `edge`,
               because a shove of 110 N for 0.3 s, on the way into the crawl, tipped the sole before
               `edge` tripped
    balance    the COM is ahead of or behind its reference. References that drift consistently with
               their rates can take it there, and no joint service can detect that

The planner checks the trips while it is engaged. `unloaded` counts only once both legs have carried
the torso, because on a hoist neither does. `sagging` counts only once the person has stopped
pressing, because a hand that pressed against HOLD first catches up. HOLD may leave the COM off its
reference, and the leading planner brings it back, so `balance` counts only an offset that has grown
by `ROOM`. A trip ends when every value has been within its limit for `CALM_NS` and the tripped
value was known throughout: a silent harness does not end a trip on its force. A trip counts as a
dropout (`services.planner.watch.engagement_fsm`): after repeated trips the planner waits ever
longer before it re-engages.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from services.planner.law.hocca import LawOutput
from shared.arrays import Array
from shared.bus.messages import Trip
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.robot.trip_table import PLANNER_TRIPS, limits_of

CALM_NS: Final = NS_PER_S
"""Time within all limits that ends a trip. A body that still swings passes through its limits
several times a second."""
LEADING_LOAD: Final = 40.0
"""N; force of a hand that leads the robot down by 0.4 m in 2 s."""
ASSUMED_SINK_RATE: Final = 1.0
"""m/s; assumed sink rate of a load beyond `LEADING_LOAD` if the planner engaged again."""
SINK_RATE_MIN: Final = 1e-3
"""m/s; minimum sink rate, used for a robot that does not sink."""
ROOM: Final = 0.02
"""m; a COM beyond the limit trips only if its offset is this much above its minimum since
engaging."""
LOADED_FACTOR: Final = 3.0
"""Multiple of the `unloaded` limit; a robot stands if both legs carry this load."""

_TRIPS: Final = tuple(PLANNER_TRIPS)
_UNLOADED: Final = _TRIPS.index(Trip.UNLOADED)
_SAGGING: Final = _TRIPS.index(Trip.SAGGING)
_OFF_BALANCE: Final = _TRIPS.index(Trip.OFF_BALANCE)


class TripsState(msgspec.Struct):
    """State of `PlannerTrips`."""

    since_ns: tuple[int, ...] = (0,) * len(PLANNER_TRIPS)
    """Time from which each value has been beyond its limit; 0 if it is not."""
    calm_ns: int = 0
    """Time from which no value has been beyond its limit; 0 otherwise."""
    tripped: Trip = Trip.NONE
    """Active trip, which prevents the planner from engaging."""
    why: str = ""
    """Text of the trip, with value and limit at its time."""
    stands: bool = False
    """True once both legs have carried the torso since the planner engaged."""
    light: bool = False
    """True once the person has stopped pressing on the robot since the planner engaged."""
    off: float = -1.0
    """Minimum offset of the COM since the planner engaged, m; -1 while it does not lead."""


class PlannerTrips:
    """Check of the trips in each tick."""

    def __init__(self, config: RobotConfig) -> None:
        limits = limits_of(config)
        rows = [getattr(limits, PLANNER_TRIPS[trip].key) for trip in _TRIPS]
        self._limits = [row.limit for row in rows]
        self._after_ns = [round(row.after_ms * NS_PER_MS) for row in rows]
        self._least = [PLANNER_TRIPS[trip].least for trip in _TRIPS]

    def advance(
        self, state: TripsState, now_ns: int, values: tuple[float, ...], *, leads: bool
    ) -> None:
        """Advance by one tick.

        Args:
            state: state of these trips; updated in place.
            now_ns: the planner's clock.
            values: result of `values_of`; NaN is unknown and never trips.
            leads: True while the planner is engaged; only then does it trip.
        """
        loaded = values[_UNLOADED] > LOADED_FACTOR * self._limits[_UNLOADED]
        state.stands = (leads or state.tripped > 0) and (state.stands or loaded)
        beyond = [
            value < limit if least else value > limit
            for value, limit, least in zip(values, self._limits, self._least, strict=True)
        ]
        beyond[_UNLOADED] &= state.stands
        state.light = leads and (state.light or values[_SAGGING] == 0.0)
        beyond[_SAGGING] &= state.light or not leads
        off = values[_OFF_BALANCE]
        state.off = (off if state.off < 0.0 else min(state.off, off)) if leads else -1.0
        beyond[_OFF_BALANCE] &= leads and off > state.off + ROOM
        state.since_ns = tuple(
            (since or now_ns) if is_beyond and leads else 0
            for since, is_beyond in zip(state.since_ns, beyond, strict=True)
        )
        unknown = state.tripped > 0 and math.isnan(values[_TRIPS.index(state.tripped)])
        state.calm_ns = 0 if unknown or any(beyond) else (state.calm_ns or now_ns)
        if state.tripped and state.calm_ns and now_ns - state.calm_ns >= CALM_NS:
            state.tripped, state.why = Trip.NONE, ""
        if leads and not state.tripped:
            for index, since in enumerate(state.since_ns):
                if since and now_ns - since >= self._after_ns[index]:
                    self._trip(state, index, values[index])
                    break

    def _trip(self, state: TripsState, index: int, value: float) -> None:
        row = PLANNER_TRIPS[_TRIPS[index]]
        state.tripped = _TRIPS[index]
        limit = f"(limit {self._limits[index]:g})"
        state.why = f"{row.measured}: {value:.3g} {row.unit} {limit}"


def values_of(
    output: LawOutput,
    q: Array,
    soles: tuple[float, float],
    edge: float,
    lifted: float | None,
    harness_rate: float,
    drift: float,
    *,
    leads: bool,
    moves: bool = False,
) -> tuple[float, ...]:
    """Return the values to check, in the order of `PLANNER_TRIPS`.

    Args:
        output: output of the law.
        q: measured joint angles (12,), rad.
        soles: loads of the right and the left sole, N.
        edge: lateral offset of a sole's pressure (`services.planner.law.feet.Soles.edge`).
        lifted: upward force of the person on the robot, N, world; None if unknown.
        harness_rate: vertical rate of the harness point, m/s, world.
        drift: drift without a hand on the robot, m.
        leads: True while the planner is engaged.
        moves: True while height and pitch are closed for heat; sagging and drift are then 0.
    """
    x, y, z = output.closure[:3].tolist()
    error = output.q_ref - q
    return (
        math.sqrt(x * x + y * y + z * z),
        output.ik_residual,
        max(float(error.max()), -float(error.min())),
        math.nan if any(map(math.isnan, soles)) else min(soles),
        abs(float(output.pdot[2])),
        abs(float(output.pdot[4])),
        _assist_error(lifted, output.assist, leads=leads),
        0.0 if moves else _pressing_power(lifted, output.assist, harness_rate, leads=leads),
        0.0 if moves else drift,
        edge,
        edge,
        abs(float(output.p_ref[0] - output.p[0])),
    )


def _assist_error(lifted: float | None, assist: float, *, leads: bool) -> float:
    """Return the error of the force on the person, N; NaN if unknown.

    In HOLD the robot does not control the requested force. Only a load beyond it, or an upward
    pull, counts.
    """
    if lifted is None:
        return math.nan
    return abs(lifted + assist) if leads else max(-lifted - assist, lifted)


def _pressing_power(lifted: float | None, assist: float, rate: float, *, leads: bool) -> float:
    """Return the power with which the person presses the robot down, W; NaN if unknown.

    It is exactly zero for loads up to `LEADING_LOAD` beyond the assist. In HOLD nothing sinks, so
    the power is that of the load at `ASSUMED_SINK_RATE`.
    """
    if lifted is None:
        return math.nan
    down = max(SINK_RATE_MIN, -rate) if leads else ASSUMED_SINK_RATE
    return max(0.0, -lifted - assist - LEADING_LOAD) * down
