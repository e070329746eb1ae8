"""When an ODrive's frames arrive on CAN: samples, silence, and what holds after an order. Pure."""

from __future__ import annotations

from math import isfinite
from typing import Final

from shared.bus.messages import Pair
from shared.clock import NS_PER_MS

REBOOT_MS: Final = 500
"""Silence after which the drive may have been switched off and on: its earlier heartbeats are
forgotten. The same holds for an axis that sends estimates and no heartbeats, because nothing else
would show that it disarmed."""
ARM_GRACE_MS: Final = 10
"""Time after an order in which heartbeats may be from before it, and are ignored."""
FEED_MS: Final = 1000
"""Time after `arm` in which reading feeds the watchdogs until the drive is ARMED: that shows only
in the next heartbeat, and a watchdog may run out before it."""
INSIST_MS: Final = 1000
"""Time after `idle` in which an axis that still reports closed loop is commanded again at once."""
PAIR_SHARE: Final = 0.6
"""Fraction of the period; an older estimate belongs to the previous sample, as after a lost frame.
More than half, so that axes out of step still make pairs."""

_REBOOT_NS: Final = REBOOT_MS * NS_PER_MS
_BOTH: Final = 0b11


class EncoderPair:
    """The newest estimates of both axes, and whether they make a sample that was not taken yet.

    Attributes:
        estimates: position and velocity of axis0, then of axis1, turns and turn/s.
    """

    def __init__(self) -> None:
        self.estimates: list[Pair] = [(0.0, 0.0), (0.0, 0.0)]
        self._came_ns = [0, 0]
        self._fresh = 0  # bit i: axis i has an estimate since the last sample

    def take(self, axis: int, estimate: Pair, now_ns: int) -> None:
        """Take an estimate of axis 0 or 1; one that is not a finite number is ignored."""
        pos, vel = estimate
        if not (isfinite(pos) and isfinite(vel)):
            return
        self.estimates[axis] = estimate
        came = self._came_ns
        if now_ns - came[1 - axis] > PAIR_SHARE * (now_ns - came[axis]):
            # Without this one lost frame would put one axis a period behind the other for good.
            self._fresh = 0
        came[axis] = now_ns
        self._fresh |= 1 << axis

    def take_both(self, first: Pair, second: Pair, now_ns: int) -> None:
        """Take estimates of both axes that came together; all are finite."""
        self.estimates[:] = first, second
        self._came_ns[:] = now_ns, now_ns
        self._fresh = _BOTH

    def forget(self) -> None:
        """Start over: earlier estimates belong to no sample."""
        self._fresh = 0

    def complete(self) -> bool:
        """Return True, once for each sample, if both axes have an estimate of the same period."""
        if self._fresh != _BOTH:
            return False
        self._fresh = 0
        return True


class FrameTimes:
    """When the frames of both axes came.

    Attributes:
        now_ns: the frames at hand.
        heard_ns: the newest heartbeat of axis0, and of axis1.
        sample_ns: the newest sample of both axes; before the first, the start.
    """

    def __init__(self, lost_after_ns: int, now_ns: int) -> None:
        """Start without frames; a drive is lost after so long without a sample."""
        self.now_ns = 0
        self.heard_ns = [0, 0]
        self.sample_ns = now_ns
        self._has_sample = False
        self._lost_after_ns = lost_after_ns

    def sampled(self, now_ns: int) -> bool:
        """Take a sample of both axes; return True if one is unheard.

        It has not sent a heartbeat for as long as a restart takes.
        """
        self.sample_ns = now_ns
        self._has_sample = True
        first_ns, second_ns = self.heard_ns
        restart_ns = now_ns - _REBOOT_NS
        return first_ns < restart_ns or second_ns < restart_ns

    def has_recent_sample(self, now_ns: int) -> bool:
        """Return False if the drive is lost: it sent no sample for too long, or never one."""
        return self._has_sample and now_ns - self.sample_ns <= self._lost_after_ns

    def may_have_restarted(self, now_ns: int) -> bool:
        """Return True after a silence as long as a restart takes."""
        return now_ns - self.sample_ns > _REBOOT_NS


class OrderWindows:
    """What holds for a while after an order to arm or to go idle.

    Attributes:
        believe_from_ns: heartbeats count from here on.
        feed_until_ns: reading feeds the watchdogs.
        insist_until_ns: an axis in closed loop has missed the order to go idle.
    """

    def __init__(self) -> None:
        """Start without an order."""
        self.believe_from_ns = 0
        self.feed_until_ns = 0
        self.insist_until_ns = 0

    def ordered(self, now_ns: int) -> None:
        """Begin with an order, or with its repetition."""
        self.believe_from_ns = now_ns + ARM_GRACE_MS * NS_PER_MS

    def armed(self, now_ns: int) -> None:
        """The last order was to arm."""
        self.feed_until_ns = now_ns + FEED_MS * NS_PER_MS
        self.insist_until_ns = 0

    def idle(self, now_ns: int) -> None:
        """The last order was to go idle."""
        self.feed_until_ns = 0
        self.insist_until_ns = now_ns + INSIST_MS * NS_PER_MS
