"""Detection of height and pitch that nobody leads, and of their drift. Pure.

Height and pitch are open: only the wearer's hand holds them. Without a hand, an error of the
feedforward or weight on the harness accelerates the robot: a torso turned by 0.8 rad within a
second of its release. The weight of a resting person does not count as a hand. Along z, the hand's
force is the force beyond the assist; about pitch, the hand's moment is the whole moment.

Without a hand, friction must brake each direction and nothing may drive it. The watch therefore
compares the rate with c, the rate when the hand left. c decays with `COAST_S` or faster:

    c        = rate, clamped between 0 and the last c;  c = rate while a hand is detected
    excess'  = rate - c;                           excess = 0 while a hand is detected
    released   if |excess + STOP_S (rate - c)| > RUNAWAY

A released direction is closed (`services.planner.law.closed_reference`) until a hand returns. If a
hand was there after all, too light to be detected, it meets resistance and opens the direction. A
pitch that stays released for `PROOF_NS` shows that nobody holds the robot. The height is then
closed too, so that the weight of a resting person cannot move it. A hand on the pitch opens both.
Further motion is drift, which trips:

    drift    = max(|z - z0|, ARM |pitch - pitch0|)       z0, pitch0: when the hand was lost
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from services.planner.law.closed_reference import Released
from shared.bus.messages import Pair
from shared.clamp import clamp
from shared.clock import NS_PER_MS, NS_PER_S

HAND_MIN: Final = (3.0, 1.0)
"""N and N m; noise and zero offsets are smaller, a leading hand is stronger (dry friction alone
takes 6 N)."""
TOUCH_MIN: Final = (3.0, 0.25)
"""N and N m; twice the noise. In 6 of 31 leads drawn at random, the feedforward drove the torso,
and the hand that guided it needed less than 1 N m for seconds."""
COAST_S: Final = 0.5
"""Time constant of c, s. Friction stops a torso 0.3 s after a hand leaves it at 0.4 rad/s."""
HAND_LOST_NS: Final = NS_PER_S // 2
"""ns; while friction helps a hand to brake the robot, the hand is not detected for up to 0.3 s."""
ARM: Final = 0.25
"""m per rad of the torso's pitch."""
RUNAWAY: Final = (0.0075, 0.04)
"""m and rad; 30 of these 31 leads stayed within 0.002 m and 0.04 rad."""
STOP_S: Final = 0.1
"""s; the closed directions stop a drift of 1 rad/s within 0.1 rad."""
HAND_BACK: Final = (25.0, 1.0)
"""N and N m; a stronger hand opens a released direction. A person who rests on the robot requests
an assist, which differs from the weight on the harness by at most 24 N."""
HAND_BACK_NS: Final = 50 * NS_PER_MS
"""ns; minimum duration of a force that opens a released direction; a bump is shorter."""
PROOF_NS: Final = 120 * NS_PER_MS
"""ns; most hands that lead the pitch are detected sooner. In 5 of 60 leads drawn at random the hand
was not detected, and its peak force rose by 5 to 32 N."""


class _OpenDirection(msgspec.Struct):
    """State of one open direction, in m or rad."""

    coast: float = 0.0
    """c, the rate when the hand left, decaying, m/s or rad/s."""
    excess: float = 0.0
    drive: float = 0.0
    """Acceleration at the release, m/s^2 or rad/s^2."""
    released_ns: int = 0
    """Time from which the direction has been without a leading hand; 0 while a hand leads it."""
    back_ns: int = 0
    """Time from which a hand has been back; 0 without a hand."""


class Unattended(msgspec.Struct):
    """Watch over height and pitch, with the pose in which a hand was last detected."""

    felt_ns: int = 0
    """Time at which a hand was last detected."""
    left: Pair | None = None
    """Pose in which the hand left the robot: COM height, m, and torso pitch, rad."""
    last_ns: int = 0
    """Time of the last tick."""
    height: _OpenDirection = msgspec.field(default_factory=_OpenDirection)
    pitch: _OpenDirection = msgspec.field(default_factory=_OpenDirection)

    @property
    def released(self) -> Released:
        """(height, pitch), each True while nobody leads it."""
        return self.height.released_ns > 0, self.pitch.released_ns > 0

    def describe(self) -> str:
        """Return a message that nobody leads; "" if a hand leads."""
        if not any(self.released):
            return ""
        return "nobody leads the robot: it stays where it is until a hand moves it"

    def advance(self, now_ns: int, pose: Pair, rates: Pair, hand: Pair, *, leads: bool) -> float:
        """Advance by one tick; return the drift, m.

        Args:
            now_ns: the planner's clock.
            pose: COM height, m, and torso pitch, rad.
            rates: rates of both, m/s and rad/s.
            hand: upward force of the person beyond the assist, N, and moment about pitch, N m; NaN
                if unknown, which counts as a hand.
            leads: True while the planner is engaged; otherwise no direction is open or released.
        """
        dt = (now_ns - self.last_ns) / NS_PER_S if self.last_ns else 0.0
        self.last_ns = now_ns
        for i, direction in enumerate((self.height, self.pitch)):
            _coast(direction, rates[i], dt, felt=not abs(hand[i]) < TOUCH_MIN[i])
            beyond = rates[i] - direction.coast
            if not leads or _is_back(direction, now_ns, hand[i], HAND_BACK[i]):
                direction.released_ns = 0
                if direction is self.pitch:  # the height was closed because nobody held the pitch
                    self.height.released_ns = 0
            elif not direction.released_ns and abs(direction.excess + STOP_S * beyond) > RUNAWAY[i]:
                direction.released_ns = now_ns
                direction.drive = 0.5 * beyond * beyond / (direction.excess or math.inf)
        pitch_ns = self.pitch.released_ns
        if pitch_ns and now_ns - pitch_ns >= PROOF_NS:
            self.height.released_ns = self.height.released_ns or now_ns
        if not (abs(hand[0]) < HAND_MIN[0] and abs(hand[1]) < HAND_MIN[1]):
            self.felt_ns = now_ns
        if self.left is None or now_ns - self.felt_ns <= HAND_LOST_NS:
            self.left = pose
        return max(abs(pose[0] - self.left[0]), ARM * abs(pose[1] - self.left[1]))


def _coast(direction: _OpenDirection, rate: float, dt: float, *, felt: bool) -> None:
    """Update c, and the distance travelled beyond it."""
    if felt:
        direction.coast, direction.excess = rate, 0.0
        return
    c = direction.coast * (1.0 - min(1.0, dt / COAST_S))
    direction.coast = clamp(rate, min(0.0, c), max(0.0, c))
    direction.excess += dt * (rate - direction.coast)


def _is_back(direction: _OpenDirection, now_ns: int, hand: float, least: float) -> bool:
    """Return True if a hand has been on a direction for `HAND_BACK_NS`, or is unknown."""
    if abs(hand) < least:
        direction.back_ns = 0
        return False
    direction.back_ns = direction.back_ns or now_ns
    return math.isnan(hand) or now_ns - direction.back_ns >= HAND_BACK_NS
