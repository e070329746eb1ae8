"""Times of an ODrive's frames on CAN: samples, silence, and windows after a command. Pure."""

from __future__ import annotations

from math import isfinite
from typing import Final

from shared.bus.messages import Pair
from shared.clock import NS_PER_MS

REBOOT_MS: Final = 500
"""Silence after which the drive may have been power-cycled, ms, so its earlier heartbeats are
forgotten. The same applies to an axis that sends estimates but no heartbeats, because nothing else
would show that it disarmed."""
ARM_GRACE_MS: Final = 10
"""Time after a command in which heartbeats may predate it and are ignored, ms."""
FEED_MS: Final = 1000
"""Time after `arm` in which `read` feeds the watchdogs until the drive is ARMED, ms. Only the next
heartbeat shows ARMED, and a watchdog may expire earlier."""
INSIST_MS: Final = 1000
"""Time after `idle` in which an axis that still reports closed loop is idled again, ms."""
PAIR_SHARE: Final = 0.6
"""Fraction of the period; if the other axis's estimate is older, it belongs to the previous sample,
as after a lost frame. More than half, so that axes out of step still form pairs."""

_REBOOT_NS: Final = REBOOT_MS * NS_PER_MS
_BOTH: Final = 0b11


class EncoderPair:
    """Newest estimates of both axes, and whether they form a new sample.

    Attributes:
        estimates: position and velocity of axis0, then of axis1, turns and turn/s.
    """

    def __init__(self) -> None:
        self.estimates: list[Pair] = [(0.0, 0.0), (0.0, 0.0)]
        self._came_ns = [0, 0]
        self._fresh = 0  # bit i: axis i has an estimate since the last sample

    def store(self, axis: int, estimate: Pair, now_ns: int) -> None:
        """Store an estimate of axis 0 or 1, unless it is not finite."""
        pos, vel = estimate
        if not (isfinite(pos) and isfinite(vel)):
            return
        self.estimates[axis] = estimate
        came = self._came_ns
        if now_ns - came[1 - axis] > PAIR_SHARE * (now_ns - came[axis]):
            # Without this, one lost frame would keep one axis a period behind the other.
            self._fresh = 0
        came[axis] = now_ns
        self._fresh |= 1 << axis

    def store_both(self, first: Pair, second: Pair, now_ns: int) -> None:
        """Store estimates of both axes that arrived together; all must be finite."""
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
    """Arrival times of both axes' frames, ns.

    Attributes:
        now_ns: time of the frames being processed.
        heard_ns: time of the newest heartbeat of axis0, and of axis1.
        sample_ns: time of the newest sample of both axes; initially the start time.
    """

    def __init__(self, lost_after_ns: int, now_ns: int) -> None:
        """Start without frames; after `lost_after_ns` without a sample the drive is lost."""
        self.now_ns = 0
        self.heard_ns = [0, 0]
        self.sample_ns = now_ns
        self._has_sample = False
        self._lost_after_ns = lost_after_ns

    def sampled(self, now_ns: int) -> bool:
        """Record a sample of both axes; return True if an axis sends no heartbeats."""
        self.sample_ns = now_ns
        self._has_sample = True
        first_ns, second_ns = self.heard_ns
        restart_ns = now_ns - _REBOOT_NS
        return first_ns < restart_ns or second_ns < restart_ns

    def has_recent_sample(self, now_ns: int) -> bool:
        """Return False if the drive is lost: it has sent no sample for too long, or none at all."""
        return self._has_sample and now_ns - self.sample_ns <= self._lost_after_ns

    def may_have_restarted(self, now_ns: int) -> bool:
        """Return True after a silence of more than `REBOOT_MS`."""
        return now_ns - self.sample_ns > _REBOOT_NS


class OrderWindows:
    """Time windows after a command to arm or to go idle, ns.

    Attributes:
        believe_from_ns: heartbeats count from this time on.
        feed_until_ns: until then, `read` feeds the watchdogs.
        insist_until_ns: until then, an axis that is still in closed loop is idled again.
    """

    def __init__(self) -> None:
        """Start without a command."""
        self.believe_from_ns = 0
        self.feed_until_ns = 0
        self.insist_until_ns = 0

    def ordered(self, now_ns: int) -> None:
        """Record a command, or its repetition."""
        self.believe_from_ns = now_ns + ARM_GRACE_MS * NS_PER_MS

    def armed(self, now_ns: int) -> None:
        """Record that the last command was to arm."""
        self.feed_until_ns = now_ns + FEED_MS * NS_PER_MS
        self.insist_until_ns = 0

    def idle(self, now_ns: int) -> None:
        """Record that the last command was to go idle."""
        self.feed_until_ns = 0
        self.insist_until_ns = now_ns + INSIST_MS * NS_PER_MS
