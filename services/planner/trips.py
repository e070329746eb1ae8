"""What the planner trips on: it asks all six modules to hold. Pure.

Each trip watches what no joint service can see by itself (`shared.robot.trip_table`; its limits are
[trips] of the robot file):

    legs       the two legs' estimates of the torso's place differ: a sole tips, or a zero is wrong
    reach      the inverse kinematics does not reach the reference pose
    tracking   a joint is far from its reference
    unloaded   a leg hardly bears the torso any more: J_leg^T W = tau, W its wrench on the torso
    sinking    COM and torso move faster than a person leads
    turning
    harness    the person is carried far otherwise than was asked for
    sagging    the person presses the robot down harder than a lead does: the power of the load
               beyond assist and lead, as it sinks
    unattended it drifts with nobody's hand on it (`services.planner.unattended`)

Judged while it leads; `unloaded` once both legs have borne the torso, for on the hoist neither
does; `sagging` once the person has not pressed, for a hand that was held up in HOLD catches up. It
ends when all of it has been within its limits for `CALM_NS`, and counts as a drop-out
(`services.planner.engagement_fsm`): what trips again and again is led ever more rarely.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.planner.hocca import LawOutput
from services.planner.snapshots import TripsState
from shared.bus.messages import Trip
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.robot.trip_table import PLANNER_TRIPS, limits_of

Array = NDArray[np.float64]

CALM_NS: Final = NS_PER_S
LEADING_LOAD: Final = 40.0
"""N: so hard a hand presses that leads down, by 0.4 m in 2 s."""
LET_DOWN_RATE: Final = 1.0
"""m/s: so fast a load beyond that would sink if it were led again."""
STANDS_RATE: Final = 1e-3
"""m/s, of one that does not sink."""
LOADED: Final = 3.0
"""Times the least load: a robot both of whose legs bear so much stands."""

_TRIPS: Final = tuple(PLANNER_TRIPS)
_UNLOADED: Final = _TRIPS.index(Trip.UNLOADED)
_SAGGING: Final = _TRIPS.index(Trip.SAGGING)


class PlannerTrips:
    """Judges each tick."""

    def __init__(self, config: RobotConfig) -> None:
        """Take the limits."""
        limits = limits_of(config)
        rows = [getattr(limits, PLANNER_TRIPS[trip].key) for trip in _TRIPS]
        self._limits = [row.limit for row in rows]
        self._after_ns = [round(row.after_ms * NS_PER_MS) for row in rows]
        self._least = [PLANNER_TRIPS[trip].least for trip in _TRIPS]
        self._memory = TripsState()

    @property
    def tripped(self) -> Trip:
        """What the planner may not lead for."""
        return self._memory.tripped

    @property
    def why(self) -> str:
        """The same in words: figure and limit as it tripped."""
        return self._memory.why

    def snapshot(self) -> TripsState:
        """Return the state."""
        return self._memory

    def restore(self, memory: TripsState) -> None:
        """Continue from a state."""
        self._memory = memory

    def advance(self, now_ns: int, values: tuple[float, ...], *, leads: bool) -> None:
        """Take one tick.

        Args:
            now_ns: the planner's clock.
            values: what `values_of` measured; NaN: not known, and no reason to trip.
            leads: the planner leads: only then it trips.
        """
        memory = self._memory
        borne = values[_UNLOADED] > LOADED * self._limits[_UNLOADED]
        stands = (leads or memory.tripped > 0) and (memory.stands or borne)
        beyond = [
            value < limit if least else value > limit
            for value, limit, least in zip(values, self._limits, self._least, strict=True)
        ]
        beyond[_UNLOADED] &= stands
        light = leads and (memory.light or values[_SAGGING] == 0.0)
        beyond[_SAGGING] &= light or not leads
        since_ns = tuple(
            (since or now_ns) if is_beyond and leads else 0
            for since, is_beyond in zip(memory.since_ns, beyond, strict=True)
        )
        tripped, why = memory.tripped, memory.why
        calm_ns = 0 if any(beyond) else (memory.calm_ns or now_ns)
        if tripped and calm_ns and now_ns - calm_ns >= CALM_NS:
            tripped, why = Trip.NONE, ""
        if leads and not tripped:
            for index, since in enumerate(since_ns):
                if since and now_ns - since >= self._after_ns[index]:
                    tripped = _TRIPS[index]
                    row = PLANNER_TRIPS[tripped]
                    why = f"{row.measured}: {values[index]:.3g} {row.unit}"
                    why += f" (limit {self._limits[index]:g})"
                    break
        self._memory = TripsState(since_ns, calm_ns, tripped, why, stands, light)


def values_of(
    output: LawOutput,
    q: Array,
    leg_loads: tuple[float, float],
    lifted: float | None,
    harness_rate: float,
    drift: float,
    *,
    leads: bool,
) -> tuple[float, ...]:
    """Return what is judged, in the order of `PLANNER_TRIPS`.

    Args:
        output: the law's.
        q: measured joint angles (12,), rad.
        leg_loads: N, of right and left leg (`Hocca.leg_loads`).
        lifted: upward force of the person on the robot, N, world; None: not known.
        harness_rate: at which the harness point rises, m/s, world.
        drift: with nobody's hand on it, m.
        leads: the planner leads.
    """
    x, y, z = output.closure[:3].tolist()
    error = output.q_ref - q
    return (
        math.sqrt(x * x + y * y + z * z),
        output.ik_residual,
        max(float(error.max()), -float(error.min())),
        math.nan if any(map(math.isnan, leg_loads)) else min(leg_loads),
        abs(float(output.pdot[2])),
        abs(float(output.pdot[4])),
        _otherwise(lifted, output.assist, leads=leads),
        _pressing(lifted, output.assist, harness_rate, leads=leads),
        drift,
    )


def _otherwise(lifted: float | None, assist: float, *, leads: bool) -> float:
    """Return how far the person is carried otherwise than asked, N; NaN: not known.

    In HOLD nobody is given what was asked for: only a load beyond it, or a pull upwards, counts.
    """
    if lifted is None:
        return math.nan
    return abs(lifted + assist) if leads else max(-lifted - assist, lifted)


def _pressing(lifted: float | None, assist: float, rate: float, *, leads: bool) -> float:
    """Return the power with which the person presses the robot down, W; NaN: not known.

    Zero for no more than the load of a lead, and for that alone. In HOLD nothing sinks: what the
    load would have at `LET_DOWN_RATE` were it led.
    """
    if lifted is None:
        return math.nan
    down = max(STANDS_RATE, -rate) if leads else LET_DOWN_RATE
    return max(0.0, -lifted - assist - LEADING_LOAD) * down
