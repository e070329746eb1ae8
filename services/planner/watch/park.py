"""Lets a person rest: closes height and pitch of a robot that stands still, crouched. Pure.

With the height open, a person who rests f on the harness and one who leads down are the same force
and the same motion; no rule can tell them apart. So a robot that stands still in a working pose is
parked: height and pitch are closed where they are, and the assist follows what rests on it.

    leads    height and pitch are the person's; A only falls
    rests    parked:   A' = (rest - A) / FOLLOW_S + LIFTS (h - z)   within 0 and the pose's cap
    away     parked, and nobody touches the harness

    rest = min(-f, -f + g (kg - kg_0))

h is the height at which it is closed, z the measured one: friction hides part of a load, and as the
robot sinks the person's own legs take up another part. The dynamic certificate holds with both
terms (`tools.lab.design.dynamic_certificate`).

f is the person's upward force, kg the load that the joints say lies beyond the robot file, and kg_0
that of the first lead: a sensor that drifts looks like a load that is taken off, and becomes no
assist. Only a net pull up or a moment backwards that lasts gives height and pitch back: weight that
is taken off looks like a pull against A, and must not open it. A request for assist wins: the robot
then leads as it does with park off. Upright nothing is closed, so a squat begins as it always does.

A shorter pull is a bump. A pull along the floor is reported, and changes nothing.
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
"""rad, theta of the straighter knee in a working pose; or the torso is pitched by `PITCHED`."""
PITCHED: Final = 0.3
CAP: Final = (-0.4, -1.4)
"""rad, the straighter knee's theta from which on the assist may follow, and with which wholly."""
FOLLOW_S: Final = 0.2
"""s; an ordinary shift of weight takes four times as long."""
LIFTS: Final = 10_000.0
"""N/s of assist per metre below the closed height; with half as much again, `FOLLOW_S` of 0.3 s and
twice the feedback, a motion grows."""
SHED_RATE: Final = 400.0
"""N/s with which the assist falls at most: a person gets up from 150 N within half a second."""
LASTS_NS: Final = 50 * NS_PER_MS
"""A force that opens must last so long: the shortest bump of a person is shorter."""
BUMPED_NS: Final = 300 * NS_PER_MS
"""How long a bump is reported."""
AWAY: Final = (3.0, 1.0)
"""N and N m; any hand on the harness is stronger."""
AWAY_NS: Final = NS_PER_S // 2
PULL: Final = 25.0
"""N along the floor."""
PULL_NS: Final = 400 * NS_PER_MS


class ParkState(msgspec.Struct):
    """State of `ParkLaw`."""

    wearing: Wearing = Wearing.LEADS
    assist: float = 0.0
    """A, N, before the limit of its rate."""
    still_ns: int = 0
    """Time since which the robot has been still in a working pose; 0: it is not."""
    away_ns: int = 0
    """Time since which nobody has touched it."""
    opens_ns: int = 0
    """Time since which a force has been opening it."""
    pull_ns: int = 0
    """Time since which somebody has pulled along the floor."""
    bumped_ns: int = 0
    """Time of the last bump."""

    @property
    def closed(self) -> bool:
        """True if height and pitch are closed."""
        return self.wearing is not Wearing.LEADS

    def shown(self, now_ns: int) -> Wearing:
        """Return what is reported: a pull and a bump come before the rest."""
        if self.pull_ns and now_ns - self.pull_ns >= PULL_NS:
            return Wearing.PULLS
        if self.bumped_ns and now_ns - self.bumped_ns < BUMPED_NS:
            return Wearing.BUMPED
        return self.wearing


class Touch(NamedTuple):
    """What the person does to the robot, and how it stands, in one tick."""

    lifted: float
    """f, N, up."""
    moment: float
    """About pitch, N m; forwards is positive."""
    level: Pair
    """Force along the torso's x and y, N."""
    pose: Vector3
    """Theta of the straighter knee, pitch of the torso, rad; and kg - kg_0."""
    rates: Pair
    """Of the COM's height, m/s, and of the pitch, rad/s."""
    sinks: float
    """By how much the COM is below where it is closed, m."""


class ParkLaw:
    """Decides when the robot is parked, and what it carries then."""

    def __init__(self, park: ParkConfig, assist: AssistConfig) -> None:
        """Take thresholds and the largest assist."""
        self.enabled = park.enabled
        self._open, self._open_back = park.open_n, park.open_back_nm
        self._still_ns = round(park.still_s * NS_PER_S)
        self._force_max = assist.force_max

    def advance(
        self, s: ParkState, now_ns: int, touch: Touch | None, park: int, dt: float, *, may: bool
    ) -> float:
        """Advance by one tick; return the assist that is wanted, N.

        Args:
            s: state, which changes.
            now_ns: the planner's clock.
            touch: what the person does; None if it is not known, which changes nothing.
            park: `Park` that is requested.
            dt: time since the last tick, s.
            may: the planner leads, nobody requests assist, and height and pitch are the person's.
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
