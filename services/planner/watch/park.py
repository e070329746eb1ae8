"""Park: closes height and pitch in a still crouch, so that a person can rest on the robot. Pure.

A robot that stands still in a working pose is parked (docs/law.md#park): the law closes height and
pitch in place, and the assist A follows the rested weight.

    leads    the person leads height and pitch; A only falls
    rests    parked:   A' = (rest - A) / FOLLOW_S + LIFTS (h - z)   from 0 to the pose's cap
    away     parked, and nobody touches the harness

    rest = min(-f, -f + g (kg - kg_0))

h is the closed height, z the measured one. The term LIFTS (h - z) makes up for the part of a load
that friction hides, and the part that the person's legs carry as the robot sinks. The dynamic
certificate includes both terms (`tools.lab.design.dynamic_certificate`).

f is the person's upward force, kg the estimated load beyond the robot file, and kg_0 its value at
the first lead. A drifting sensor looks like a load that was taken off, so it adds no assist. Only a
lasting net pull up, or a lasting moment backwards, opens height and pitch. Weight that is taken off
looks like a pull against A, and must not open them. A request for assist takes precedence: height
and pitch are then open, as with park off. An upright robot is never parked, so a squat starts as
usual.

A shorter pull or moment is a bump. A pull along the floor is only reported.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import msgspec

from services.planner.law.assist import is_still
from shared.bus.messages import Pair, Park, Vector3, Wearing
from shared.clamp import clamp
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import GRAVITY
from shared.config.sections import AssistConfig, ParkConfig

BENT: Final = -1.25
"""rad; in a working pose, theta of the straighter knee is below this, or pitch above `PITCHED`."""
PITCHED: Final = 0.3
CAP: Final = (-0.4, -1.4)
"""rad; theta of the straighter knee at which the assist's cap is zero, and at which it is full."""
FOLLOW_S: Final = 0.2
"""s; time constant of the assist. A person's ordinary shift of weight takes four times as long."""
LIFTS: Final = 10_000.0
"""N/s of assist per metre below the closed height; at 1.5 times this, with `FOLLOW_S` of 0.3 s and
twice the feedback, a motion grows."""
SHED_RATE: Final = 400.0
"""N/s; maximum rate at which the assist falls. A person gets up from 150 N within half a second."""
LASTS_NS: Final = 50 * NS_PER_MS
"""Minimum duration of a pull or moment that opens height and pitch; a bump is shorter."""
BUMPED_NS: Final = 300 * NS_PER_MS
"""Time for which a bump is reported."""
AWAY: Final = (3.0, 1.0)
"""N and N m; any hand on the harness is stronger."""
AWAY_NS: Final = NS_PER_S // 2
PULL: Final = 25.0
"""N along the torso's x or y."""
PULL_NS: Final = 400 * NS_PER_MS


class ParkState(msgspec.Struct):
    """State of `ParkLaw`."""

    wearing: Wearing = Wearing.LEADS
    assist: float = 0.0
    """A, N, before the limit of its rate."""
    still_ns: int = 0
    """Time from which the robot has been still in a working pose; 0 if it is not."""
    away_ns: int = 0
    """Time from which the robot has been untouched; 0 while somebody touches it."""
    opens_ns: int = 0
    """Time from which a force that can open height and pitch has acted; 0 without such a force."""
    pull_ns: int = 0
    """Time from which somebody has pulled along the floor; 0 without a pull."""
    bumped_ns: int = 0
    """Time of the last bump."""

    @property
    def closed(self) -> bool:
        """True if height and pitch are closed."""
        return self.wearing is not Wearing.LEADS

    def reported(self, now_ns: int) -> Wearing:
        """Return the state to report; a pull takes precedence, then a bump."""
        if self.pull_ns and now_ns - self.pull_ns >= PULL_NS:
            return Wearing.PULLS
        if self.bumped_ns and now_ns - self.bumped_ns < BUMPED_NS:
            return Wearing.BUMPED
        return self.wearing


class Touch(NamedTuple):
    """Person's forces on the robot, and the robot's pose, in one tick."""

    lifted: float
    """f, N, up."""
    moment: float
    """About pitch, N m; forwards is positive."""
    level: Pair
    """Force along the torso's x and y, N."""
    pose: Vector3
    """Theta of the straighter knee and pitch of the torso, rad; and kg - kg_0."""
    rates: Pair
    """Rates of the COM's height, m/s, and of the pitch, rad/s."""
    sinks: float
    """Distance of the COM below its closed height, m."""


class ParkLaw:
    """Decision on parking, and the assist of a parked robot."""

    def __init__(self, park: ParkConfig, assist: AssistConfig) -> None:
        self.enabled = park.enabled
        self._open, self._open_back = park.open_n, park.open_back_nm
        self._still_ns = round(park.still_s * NS_PER_S)
        self._force_max = assist.force_max

    def advance(
        self, s: ParkState, now_ns: int, touch: Touch | None, park: int, dt: float, *, may: bool
    ) -> float:
        """Advance by one tick; return the assist of a parked robot, N.

        Args:
            s: state of the park law; updated in place.
            now_ns: the planner's clock.
            touch: forces and pose of this tick; None if unknown, which keeps the assist.
            park: requested `Park`.
            dt: time since the last tick, s.
            may: True while the planner leads, nobody requests assist, and the robot does not move
                on its own.
        """
        if touch is None:
            s.opens_ns = s.still_ns = s.away_ns = s.pull_ns = 0
        else:
            self._note(s, now_ns, touch)
        if not may or park != Park.AUTO:
            s.wearing = Wearing.LEADS
        elif touch is not None:
            s.wearing = self._next(s, now_ns)
        if touch is not None:
            self._follow(s, touch, dt)
        return s.assist

    def _note(self, s: ParkState, now_ns: int, touch: Touch) -> None:
        works = touch.pose[0] < BENT or touch.pose[1] > PITCHED
        s.still_ns = (s.still_ns or now_ns) if works and is_still(*touch.rates) else 0
        is_away = abs(touch.lifted) < AWAY[0] and abs(touch.moment) < AWAY[1]
        s.away_ns = (s.away_ns or now_ns) if is_away else 0
        s.pull_ns = (s.pull_ns or now_ns) if max(map(abs, touch.level)) > PULL else 0
        opens = touch.lifted > self._open or touch.moment < -self._open_back
        if s.opens_ns and not opens and now_ns - s.opens_ns < LASTS_NS:
            s.bumped_ns = now_ns
        s.opens_ns = (s.opens_ns or now_ns) if opens else 0

    def _next(self, s: ParkState, now_ns: int) -> Wearing:
        if s.opens_ns and (s.wearing is Wearing.LEADS or now_ns - s.opens_ns >= LASTS_NS):
            s.still_ns = s.away_ns = 0
            return Wearing.LEADS
        if s.wearing is not Wearing.LEADS:
            is_away = s.away_ns and now_ns - s.away_ns >= AWAY_NS
            return Wearing.AWAY if is_away else Wearing.RESTS
        parks = s.still_ns and now_ns - s.still_ns >= self._still_ns
        return Wearing.RESTS if parks else Wearing.LEADS

    def _follow(self, s: ParkState, touch: Touch, dt: float) -> None:
        knee, _, kg = touch.pose
        rest = max(0.0, -touch.lifted + GRAVITY * min(0.0, kg))
        cap = self._force_max * clamp((knee - CAP[0]) / (CAP[1] - CAP[0]), 0.0, 1.0)
        rate = (rest - s.assist) / FOLLOW_S + LIFTS * touch.sinks
        if s.wearing is Wearing.LEADS:
            rate = min(0.0, (rest - s.assist) / FOLLOW_S)
        s.assist = clamp(s.assist + dt * rate, 0.0, max(cap, s.assist - dt * SHED_RATE))
