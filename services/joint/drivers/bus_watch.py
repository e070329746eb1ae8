"""State of a CAN bus: whether the drive sends, and whether our frames are carried. Pure.

A CAN controller repeats a frame until a node acknowledges it: the bus has then carried the frame.
If no node has power, the controller repeats it endlessly. Later frames wait behind it in the
adapter, the interface's queue and the socket, and all reach the drive when its power is back. The
kernel drops no frame because of its age. So the link sends no frame that might have to wait:

- it sends only probes and first requests unless the drive has sent a frame within `QUIET_MS`;
- it sends nothing while one of our frames has had no echo for `STUCK_MS` (CAN_RAW_RECV_OWN_MSGS:
  the echo shows that the bus has carried it);
- it restarts the interface to discard frames without an echo for `RESTART_MS`;
- it requests arming only if the bus has carried one of our frames within `PROOF_MS`.

After an outage, one harmless frame, the probe, must be carried before anything else is sent.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from shared.clock import NS_PER_MS

QUIET_MS: Final = 20
"""Silence of the drive after which only probes are sent, ms: ten encoder frames at 500 Hz."""
STUCK_MS: Final = 15
"""Time within which any live bus carries a frame of ours, ms: a queue of 100 frames takes 13 ms."""
RESTART_MS: Final = 30
"""Age at which frames that were not carried are discarded, ms: with a cycle of 5 ms and the restart
itself, none becomes 50 ms old."""
ASK_AFTER_NS: Final = 4 * NS_PER_MS
"""Age of a frame of ours above which the link queries `xrl_unix` for carried frames, ns; each query
is a system call."""
PROOF_MS: Final = 50
"""Maximum time since the bus carried one of our frames, for an arming request, ms."""
PROBE_MS: Final = 100
"""Period of probes on a bus that carries none of our frames although the drive sends, ms."""
BLOCKED_MS: Final = 100
"""Time without a carried frame, since one was refused (ENOBUFS) or discarded, after which even a
drive that sends counts as lost, ms."""

_QUIET_NS: Final = QUIET_MS * NS_PER_MS
_STUCK_NS: Final = STUCK_MS * NS_PER_MS
_NEVER: Final = -(1 << 62)


class BusWatch:
    """Tracks when the drive last sent a frame, and which of our frames have not been carried yet.

    Attributes:
        echoes: True if the interface returns our frames once they are carried. Otherwise each frame
            from the drive counts as proof that the bus carries frames.
        unacknowledged: True after our frames were not carried, until one is.
    """

    def __init__(self, *, echoes: bool) -> None:
        """Start with a bus on which no frame has been received."""
        self.echoes = echoes
        self.unacknowledged = False
        self._heard_ns = self._carried_ns = self._probed_ns = _NEVER
        self._blocked_ns = 0
        self._waiting: deque[int] = deque()
        self._can_restart = True

    def received(self, now_ns: int) -> None:
        """Record a frame from the drive."""
        self._heard_ns = now_ns
        if not self.echoes:
            self.carried(now_ns)

    def sent(self, now_ns: int) -> None:
        """Record that the bus accepted one of our frames, whose echo must follow."""
        if self.echoes:
            self._waiting.append(now_ns)

    def refused(self, now_ns: int) -> None:
        """Record that the bus had no room for a frame."""
        self._blocked_ns = self._blocked_ns or now_ns

    def carried(self, now_ns: int) -> None:
        """Record the echo of one of our frames, or another proof that the bus carries frames.

        Frames are carried in order, so frames sent long before were carried too, even if their
        echoes were lost in a full receive buffer.
        """
        self._carried_ns = now_ns
        self._blocked_ns = 0
        self.unacknowledged = False
        waiting = self._waiting
        if waiting:
            waiting.popleft()
        while waiting and now_ns - waiting[0] > _STUCK_NS:
            waiting.popleft()

    def is_heard(self, now_ns: int) -> bool:
        """Return True if the drive has sent a frame within `QUIET_MS`."""
        return now_ns - self._heard_ns <= _QUIET_NS

    def may_send(self, now_ns: int) -> bool:
        """Return True if a frame would not have to wait."""
        if self.unacknowledged or now_ns - self._heard_ns > _QUIET_NS:
            return False
        waiting = self._waiting
        return not waiting or now_ns - waiting[0] <= _STUCK_NS

    def may_arm(self, now_ns: int) -> bool:
        """Return True if `may_send`, and if the bus has carried a frame within `PROOF_MS`."""
        return self.may_send(now_ns) and now_ns - self._carried_ns <= PROOF_MS * NS_PER_MS

    def carries_nothing(self, now_ns: int) -> bool:
        """Return True if the bus carried none of our frames for `BLOCKED_MS` although it should."""
        return bool(self._blocked_ns) and now_ns - self._blocked_ns > BLOCKED_MS * NS_PER_MS

    @property
    def waits(self) -> bool:
        """True while echoes of our frames are missing."""
        return bool(self._waiting)

    def heard_in_order(self, now_ns: int) -> bool:
        """Record a frame from the drive; return True if the bus needs nothing else this cycle."""
        if not self.echoes:
            self.received(now_ns)
            return True
        self._heard_ns = now_ns
        waiting = self._waiting
        return not self.unacknowledged and (not waiting or now_ns - waiting[0] < ASK_AFTER_NS)

    def waited_ns(self, now_ns: int) -> int:
        """Return the age of the oldest frame of ours without an echo, ns; 0 if all have one."""
        return now_ns - self._waiting[0] if self._waiting else 0

    def restart_due(self, now_ns: int) -> bool:
        """Return True if waiting frames must be discarded, because they are too old."""
        waiting = self._waiting
        return bool(waiting) and now_ns - waiting[0] > RESTART_MS * NS_PER_MS

    def restarted(self, now_ns: int, *, done: bool) -> None:
        """Record that the interface was restarted, or that this process may not restart it.

        Without a restart, the waiting frames (sent within about `STUCK_MS`) stay queued, and
        a silent bus is not probed.
        """
        self.unacknowledged = True
        self.refused(now_ns)
        self._can_restart = done
        self._waiting.clear()

    def probe_due(self, now_ns: int) -> bool:
        """Return True if a probe is due, and count it as sent.

        An unacknowledged bus is probed as soon as the drive sends, then every `PROBE_MS`. A bus
        that has fallen silent is probed once, to find out whether it has any node.
        """
        if not self.echoes or self._waiting or now_ns - self._probed_ns < PROBE_MS * NS_PER_MS:
            return False
        heard = self.is_heard(now_ns)
        if self.unacknowledged:
            due = heard
        else:
            due = not heard and self._probed_ns < self._heard_ns and self._can_restart
        if not due:
            return False
        self._probed_ns = now_ns
        return True

    def reopened(self) -> None:
        """Start over with a newly opened bus; the next frame shows whether old ones still wait."""
        self._waiting.clear()
        self._blocked_ns = 0
