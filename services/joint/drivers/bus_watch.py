"""State of a CAN bus: whether the drive sends, and whether own frames are carried. Pure.

A CAN controller repeats its frame until some node acknowledges it. On a bus whose nodes have no
power, it repeats without end: later frames wait behind it in the adapter, the interface's queue and
the socket, and all of them reach the drive when its power is back. The kernel drops none for its
age. So the link sends no frame that might have to wait:

- it sends nothing unless the drive was heard within `QUIET_MS`;
- it sends nothing while an own frame has not come back (CAN_RAW_RECV_OWN_MSGS: the adapter has
  transmitted it) within `STUCK_MS`;
- a restart of the interface discards frames that have not come back within `RESTART_MS`;
- an arming request needs an own frame that was carried within `PROOF_MS`.

After an outage, one harmless frame, the probe, must be carried before anything else is sent.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from shared.clock import NS_PER_MS

QUIET_MS: Final = 20
"""Silence of the drive after which nothing is sent: ten of its encoder frames at 2 ms."""
STUCK_MS: Final = 15
"""Time within which any live bus carries an own frame: a queue of 100 frames takes 13 ms."""
RESTART_MS: Final = 30
"""Age at which frames that were not carried are discarded: with a cycle of 5 ms and the restart
itself, none becomes 50 ms old."""
ASK_AFTER_NS: Final = 4 * NS_PER_MS
"""Age of an own frame from which the link queries `xrl_unix` whether the bus has carried it, ns:
the query is a system call."""
PROOF_MS: Final = 50
"""An arming request goes only to a bus that has carried an own frame within this time."""
PROBE_MS: Final = 100
"""Time between two probes of a bus that acknowledges nothing although the drive is heard."""
BLOCKED_MS: Final = 100
"""Time without a carried frame, after one was refused (ENOBUFS) or discarded, after which a drive
that is heard counts as lost."""

_QUIET_NS: Final = QUIET_MS * NS_PER_MS
_STUCK_NS: Final = STUCK_MS * NS_PER_MS
_NEVER: Final = -(1 << 62)


class BusWatch:
    """Tracks when the drive was last heard, and which own frames have not been carried yet.

    Attributes:
        echoes: True if the interface hands own frames back once they are carried. Otherwise every
            frame that the bus accepts counts as carried, and hearing the drive is the only proof.
        unacknowledged: True from when own frames were not carried until one is.
    """

    def __init__(self, *, echoes: bool) -> None:
        """Start with a bus on which nothing was heard."""
        self.echoes = echoes
        self.unacknowledged = False
        self._heard_ns = self._carried_ns = self._probed_ns = _NEVER
        self._blocked_ns = 0
        self._waiting: deque[int] = deque()
        self._can_restart = True

    def received(self, now_ns: int) -> None:
        """Record a frame of the drive."""
        self._heard_ns = now_ns
        if not self.echoes:
            self.carried(now_ns)

    def sent(self, now_ns: int) -> None:
        """Record that the bus accepted an own frame, which it must hand back."""
        if self.echoes:
            self._waiting.append(now_ns)

    def refused(self, now_ns: int) -> None:
        """Record that the bus had no room for a frame."""
        self._blocked_ns = self._blocked_ns or now_ns

    def carried(self, now_ns: int) -> None:
        """Record an own frame that came back, or one that shows that it was carried.

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
        """Return True if the drive was heard within `QUIET_MS`."""
        return now_ns - self._heard_ns <= _QUIET_NS

    def may_send(self, now_ns: int) -> bool:
        """Return True if a frame would not have to wait."""
        if self.unacknowledged or now_ns - self._heard_ns > _QUIET_NS:
            return False
        waiting = self._waiting
        return not waiting or now_ns - waiting[0] <= _STUCK_NS

    def may_arm(self, now_ns: int) -> bool:
        """Return True if, in addition, the bus has carried a frame within `PROOF_MS`."""
        return self.may_send(now_ns) and now_ns - self._carried_ns <= PROOF_MS * NS_PER_MS

    def carries_nothing(self, now_ns: int) -> bool:
        """Return True if the bus has carried no own frame for `BLOCKED_MS` although it should."""
        return bool(self._blocked_ns) and now_ns - self._blocked_ns > BLOCKED_MS * NS_PER_MS

    @property
    def waits(self) -> bool:
        """True while own frames have not come back."""
        return bool(self._waiting)

    def heard_in_order(self, now_ns: int) -> bool:
        """As `heard`; return True if the bus needs no other action of the link in this cycle."""
        if not self.echoes:
            self.received(now_ns)
            return True
        self._heard_ns = now_ns
        waiting = self._waiting
        return not self.unacknowledged and (not waiting or now_ns - waiting[0] < ASK_AFTER_NS)

    def waited_ns(self, now_ns: int) -> int:
        """Return the age of the oldest own frame that has not come back, ns; 0 if all have."""
        return now_ns - self._waiting[0] if self._waiting else 0

    def restart_due(self, now_ns: int) -> bool:
        """Return True if waiting frames must no longer reach the drive."""
        waiting = self._waiting
        return bool(waiting) and now_ns - waiting[0] > RESTART_MS * NS_PER_MS

    def restarted(self, now_ns: int, *, done: bool) -> None:
        """Record that the interface was restarted, or that this process is not allowed to.

        Without a restart the frames stay, at most those of `STUCK_MS`, and no silent bus is probed.
        """
        self.unacknowledged = True
        self.refused(now_ns)
        self._can_restart = done
        self._waiting.clear()

    def probe_due(self, now_ns: int) -> bool:
        """Return True if a probe is due, and count it as sent.

        A bus that has carried nothing is probed as soon as the drive is heard, then every
        `PROBE_MS`. A silent bus is probed once, to find out whether any node is there.
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
