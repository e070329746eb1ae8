"""References of the directions that no hand leads: shift, height and pitch. Pure.

**Shift.** By default the robot keeps its COM over the ankles and its torso upright. The operator
may request a small offset (`operator/intent`): COM forward or sideways, torso rolled or yawed. A
second-order follower with limits tracks the request without a jump. It takes at least `SHIFT_S`
from the middle to a limit and stays within `law.shift_max`:

    r'' = w^2 (wanted - r) - 2 w r',   |r'| <= shift_max / SHIFT_S

**Height and pitch.** Height and torso pitch are open: a hand leads them. The law closes both to
lower the robot (`xrl down`, a low battery) or to raise it (`services.planner.watch.reserves`). The
height reference h then moves at a bounded rate until a knee is at the end of its range; the pitch
reference stays constant. The law also closes a direction that nobody leads
(`services.planner.watch.unattended`), and both if the robot parks. The references start at the
measured pose, and h at the measured rate, so nothing steps. z is the measured height.

    p_ref    = (1 - hold) p_ref    + hold (h, pitch)             hold: for height, for pitch
    pdot_ref = (1 - hold) pdot_ref + hold (h', 0)
    |h'| <= RATE_MAX,  |h'| <= APPROACH (distance of the knee from its end)
    |h''| <= ACCELERATION;  STOPPING for a height that is closed in place
    |h - z| <= lead: a joint service accepts no more, and a hand can stop the robot
    F_lift'  = FORCE_RATE (h - z) / lead,   0 <= F_lift <= FORCE_MAX, while toward is UP or REST
    M'       = MOMENT_GAIN (pitch_ref - pitch), |M| <= MOMENT_MAX, while nobody leads the pitch

The local gains are soft along pitch (30 N m/rad are required), so M holds a torso that the robot
file describes wrongly. M starts from the torso's acceleration at its release. F_lift overcomes a
hand that presses on a rising robot. It acts at the COM: at the harness, ahead of the pitch axis, it
would turn a torso that nobody holds.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Final

import msgspec

from shared.arrays import Array
from shared.bus.messages import Pair, Vector4
from shared.clamp import clamp

ROWS: Final = (0, 1, 3, 5)
"""Rows of p that the shift moves: x, y, roll, yaw."""
SHIFT_S: Final = 1.0
"""Minimum time from the middle to the end of the range, s."""
OMEGA: Final = 6.0
"""w, rad/s; the follower is critically damped."""


class ShiftState(msgspec.Struct):
    """State of `ShiftReference`: x, y in m, roll, yaw in rad, and their rates."""

    at: list[float] = msgspec.field(default_factory=lambda: [0.0] * len(ROWS))
    rate: list[float] = msgspec.field(default_factory=lambda: [0.0] * len(ROWS))

    def stop(self) -> None:
        """Stop at the current shift, because the planner is not engaged."""
        self.rate = [0.0] * len(ROWS)

    def add_to(self, p: Array, pdot: Array) -> None:
        """Add the shift to a pose p (6,), m and rad, and its rate to pdot (6,), per s."""
        for row, at, rate in zip(ROWS, self.at, self.rate, strict=True):
            p[row] += at
            pdot[row] += rate


class ShiftReference:
    """Reference (x, y, roll, yaw) that follows the requested shift.

    It uses plain floats: for four values, NumPy's calls cost more than the arithmetic.
    """

    def __init__(self, shift_max: Sequence[float]) -> None:
        self._shift_max = tuple(shift_max)

    def advance(self, s: ShiftState, wanted: Vector4, dt: float) -> None:
        """Follow the request for dt seconds.

        Args:
            s: the shift; updated in place.
            wanted: x, y in m, roll, yaw in rad; clipped to the limits.
            dt: time since the last tick, s.
        """
        at, rate = s.at, s.rate
        for i, limit in enumerate(self._shift_max):
            target, rate_max = clamp(wanted[i], -limit, limit), limit / SHIFT_S
            rate_next = rate[i] + dt * OMEGA * (OMEGA * (target - at[i]) - 2.0 * rate[i])
            rate[i] = clamp(rate_next, -rate_max, rate_max)
            at[i] += dt * rate[i]


class Toward(IntEnum):
    """Direction in which the robot moves on its own, or PERSON."""

    DOWN = -1
    REST = 0
    """Stay at the current height and pitch."""
    UP = 1
    PERSON = 2
    """The person leads height and pitch."""


RATE_MAX: Final = 0.05
"""m/s; the robot rises from the deepest squat to straight legs in 6 s."""
ACCELERATION: Final = 0.1
"""m/s^2"""
STOPPING: Final = 1.0
"""m/s^2; deceleration of a height that nobody leads. It stops from 0.16 m/s within 13 mm."""
APPROACH: Final = 0.2
"""m/s per rad between the knee and the end of its range; the last centimetres take seconds."""
HOLD_S: Final = 0.5
"""Time to close or to open height and pitch, s."""
RELEASED_S: Final = 0.1
"""Time to close a direction that nobody leads, s; meanwhile a torso gains up to 0.35 rad/s."""
LEAD_MAX: Final = 0.012
"""m; maximum |h - z|. Deflected by this, the local springs balance a hand's force of 65 N beyond
the estimated load."""
LEAD_ANGLE: Final = 0.08
"""rad; maximum distance of a joint from its reference, about half of its limits in the trips and in
the joint service (`trips.tracking`, `envelope.q_ref_distance`)."""
LEAD_PITCH: Final = 0.12
"""rad; maximum |pitch_ref - pitch|."""
FORCE_RATE: Final = 60.0
"""N/s; rate of F_lift at the maximum |h - z|."""
FORCE_MAX: Final = 200.0
"""N beyond the assist; a leading hand presses with at most 150 N. Together with the full assist, it
stays below a harness overload (500 N)."""
FADE_RATE: Final = 30.0
"""N/s; F_lift fades at this rate once the person leads again or the robot goes down."""
MOMENT_GAIN: Final = 80.0
"""N m/s per rad; with 200 a released torso swayed by 0.04 rad at 1 Hz."""
MOMENT_FIRST: Final = 8.0
"""N m; maximum of M's first value: a step of 4 N m at each hip."""
MOMENT_MAX: Final = 30.0
"""N m; `law.load_correction` accepts 20, and 25 N of a person at the harness add 7."""
MOMENT_FADE_RATE: Final = 30.0
"""N m/s; M fades at this rate once a hand leads the pitch, or the robot moves on its own."""
_ROWS: Final = (2, 4)

# Constants, because each tick compares them (docs/contributing.md, The control path).
_DOWN, _UP, _PERSON = Toward.DOWN, Toward.UP, Toward.PERSON


Released = tuple[bool, bool]
"""(height, pitch), each True while nobody leads it."""


class HeightState(msgspec.Struct, array_like=True):
    """State of `HeightReference`."""

    height: float = 0.0
    """h, m."""
    rate: float = 0.0
    """h', m/s."""
    pitch: float = 0.0
    """rad"""
    hold: Pair = (0.0, 0.0)
    """Fractions by which height and pitch are closed, 0 .. 1; at 0 the person leads."""
    fade_s: float = HOLD_S
    """Time in which `hold` changes from 0 to 1, s."""
    force: float = 0.0
    """F_lift, N, upwards at the COM."""
    moment: float = 0.0
    """M, N m, about the torso's pitch."""
    T_z: float = 0.0
    """Largest |dq/dz| at the last reference, rad/m."""

    @property
    def is_active(self) -> bool:
        """True while height or pitch is closed, or a force or moment remains."""
        return any(self.hold) or self.force > 0.0 or self.moment != 0.0

    def apply(self, p_ref: Array, pdot_ref: Array) -> None:
        """Close height and pitch in a reference p_ref (6,) and its rate pdot_ref (6,)."""
        for row, hold, at, rate in zip(
            _ROWS, self.hold, (self.height, self.pitch), (self.rate, 0.0), strict=True
        ):
            if hold > 0.0:
                p_ref[row] += hold * (at - p_ref[row])
                pdot_ref[row] += hold * (rate - pdot_ref[row])

    def reset(self) -> None:
        """Open height and pitch at once, because the planner does not lead."""
        self.hold, self.rate, self.force, self.moment = (0.0, 0.0), 0.0, 0.0, 0.0


class HeightReference:
    """References that close height and pitch while no hand leads them."""

    def __init__(self, knees: Pair) -> None:
        """Set the knees' theta at the lowest and at the highest pose, rad."""
        self._knees = knees

    def advance(
        self,
        s: HeightState,
        toward: Toward,
        released: Released,
        drive: float,
        p: Array,
        pdot: Array,
        knees: Pair,
        dt: float,
    ) -> Pair:
        """Advance by one tick; return the force, N, and the moment about pitch, N m.

        Args:
            s: state of the closed directions; updated in place.
            toward: direction in which the robot moves on its own.
            released: (height, pitch), each True while nobody leads it; such a direction is closed
                in place, unless the robot moves on its own.
            drive: moment that turned the torso when its pitch was released, N m.
            p: measured pose (6,), m and rad.
            pdot: its rate (6,).
            knees: theta of both knees, rad.
            dt: time since the last tick, s.
        """
        z, pitch = float(p[2]), float(p[4])
        wanted = 0.0
        closed = released
        if toward is not _PERSON:
            closed, s.fade_s = (True, True), HOLD_S
            low, high = self._knees
            left = min(knees) - low if toward is _DOWN else high - max(knees)
            wanted = toward * min(RATE_MAX, APPROACH * max(0.0, left))
        elif any(released):
            s.fade_s = RELEASED_S
        if s.hold[0] == 0.0:
            s.height, s.rate = z, float(pdot[2])
        if s.hold[1] == 0.0:
            s.pitch = pitch
            if closed[1] and toward is _PERSON:
                s.moment -= clamp(drive, -MOMENT_FIRST, MOMENT_FIRST)
        step = dt / s.fade_s
        held_z, held_pitch = s.hold
        s.hold = (
            clamp(held_z + (step if closed[0] else -step), 0.0, 1.0),
            clamp(held_pitch + (step if closed[1] else -step), 0.0, 1.0),
        )
        lead = min(LEAD_MAX, LEAD_ANGLE / max(s.T_z, 1.0))
        if s.hold[0] > 0.0:
            step = dt * (STOPPING if toward is _PERSON else ACCELERATION)
            s.rate += clamp(wanted - s.rate, -step, step)
            s.height = clamp(s.height + dt * s.rate, z - lead, z + lead)
        s.pitch = clamp(s.pitch, pitch - LEAD_PITCH, pitch + LEAD_PITCH)
        if toward is _DOWN or toward is _PERSON:
            s.force -= clamp(s.force, 0.0, FADE_RATE * dt)
        else:
            s.force += s.hold[0] * FORCE_RATE * dt * (s.height - z) / lead
            s.force = clamp(s.force, 0.0, FORCE_MAX)
        if closed[1] and toward is _PERSON:
            s.moment += MOMENT_GAIN * dt * (s.pitch - pitch)
            s.moment = clamp(s.moment, -MOMENT_MAX, MOMENT_MAX)
        else:
            fade = MOMENT_FADE_RATE * dt
            s.moment -= clamp(s.moment, -fade, fade)
        return s.force, s.moment
