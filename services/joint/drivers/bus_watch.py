"""What a CAN link knows of its bus: is the drive heard, are our frames carried. Pure.

A controller repeats its frame until some node acknowledges it. On a bus whose nodes have no power
it does so for ever: later frames wait behind it in the adapter, the interface's queue and the
socket, and all of them reach the drive when its power is back. The kernel drops none for its age.
So the link hands over no frame that might have to wait:

- nothing goes out unless the drive was heard within `QUIET_MS`;
- nothing goes out while an own frame has not come back (CAN_RAW_RECV_OWN_MSGS: the adapter has
  transmitted it) within `STUCK_MS`;
- what has not come back within `RESTART_MS` is thrown away, by a restart of the interface;
- an arming request needs an own frame that was carried within `PROOF_MS`.

After an outage one harmless frame, the probe, has to be carried before anything else goes out.
"""

from __future__ import annotations

from collections import deque
from typing import Final

from shared.clock import NS_PER_MS

QUIET_MS: Final = 20
"""Silence of the drive after which nothing is sent: ten of its encoder frames at 2 ms."""
STUCK_MS: Final = 15
"""Time by which an own frame is carried on any live bus: a queue of 100 frames takes 13 ms."""
RESTART_MS: Final = 30
"""Age at which frames that were not carried are thrown away: with a cycle of 5 ms and the restart
itself none becomes 50 ms old."""
ASK_AFTER_NS: Final = 4 * NS_PER_MS
"""Age of an own frame from which `xrl_unix` is asked whether the bus has carried it: asking is a
system call."""
PROOF_MS: Final = 50
"""An arming request goes only to a bus that has carried an own frame within this time."""
PROBE_MS: Final = 100
"""Time between two probes of a bus that acknowledges nothing, though the drive is heard."""
BLOCKED_MS: Final = 100
"""Time without a carried frame, after one was refused (ENOBUFS) or thrown away, after which a drive
that is heard counts as lost."""

_QUIET_NS: Final = QUIET_MS * NS_PER_MS
_STUCK_NS: Final = STUCK_MS * NS_PER_MS
_NEVER: Final = -(1 << 62)


class BusWatch:
    """Keeps when the drive was heard, and which own frames have not been carried yet.

    Attributes:
        echoes: the interface hands own frames back once they are carried. Without that the bus
            counts as carrying what it takes, and hearing the drive is all the proof there is.
        unacknowledged: own frames were not carried, and none has been since.
    """

    def __init__(self, *, echoes: bool) -> None:
        """Begin with a bus on which nothing was heard."""
        self.echoes = echoes
        self.unacknowledged = False
        self._heard_ns = self._carried_ns = self._probed_ns = _NEVER
        self._blocked_ns = 0
        self._waiting: deque[int] = deque()
        self._can_restart = True

    def heard(self, now_ns: int) -> None:
        """Take in that a frame of the drive has come."""
        self._heard_ns = now_ns
        if not self.echoes:
            self.carried(now_ns)

    def sent(self, now_ns: int) -> None:
        """Take in that the bus has taken an own frame that it is to hand back."""
        if self.echoes:
            self._waiting.append(now_ns)

    def refused(self, now_ns: int) -> None:
        """Take in that the bus had no room for a frame."""
        self._blocked_ns = self._blocked_ns or now_ns

    def carried(self, now_ns: int) -> None:
        """Take in that an own frame has come back, or one that shows that it was carried.

        Frames are carried in order, so what was sent long before has been too, even if its echo was
        lost in a full receive buffer.
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
        """Return True if the drive was heard just now."""
        return now_ns - self._heard_ns <= _QUIET_NS

    def may_send(self, now_ns: int) -> bool:
        """Return True if a frame would not have to wait."""
        if self.unacknowledged or now_ns - self._heard_ns > _QUIET_NS:
            return False
        waiting = self._waiting
        return not waiting or now_ns - waiting[0] <= _STUCK_NS

    def may_arm(self, now_ns: int) -> bool:
        """Return True if the bus has just carried a frame as well."""
        return self.may_send(now_ns) and now_ns - self._carried_ns <= PROOF_MS * NS_PER_MS

    def carries_nothing(self, now_ns: int) -> bool:
        """Return True if for `BLOCKED_MS` no own frame was carried that the bus was to carry."""
        return bool(self._blocked_ns) and now_ns - self._blocked_ns > BLOCKED_MS * NS_PER_MS

    @property
    def waits(self) -> bool:
        """True while own frames have not come back."""
        return bool(self._waiting)

    def heard_in_order(self, now_ns: int) -> bool:
        """As `heard`; return True if the bus needs nothing else of the link in this cycle."""
        if not self.echoes:
            self.heard(now_ns)
            return True
        self._heard_ns = now_ns
        waiting = self._waiting
        return not self.unacknowledged and (not waiting or now_ns - waiting[0] < ASK_AFTER_NS)

    def waited_ns(self, now_ns: int) -> int:
        """Return the age of the oldest own frame that has not come back; 0: all have."""
        return now_ns - self._waiting[0] if self._waiting else 0

    def restart_due(self, now_ns: int) -> bool:
        """Return True if frames wait that must not reach the drive any more."""
        waiting = self._waiting
        return bool(waiting) and now_ns - waiting[0] > RESTART_MS * NS_PER_MS

    def restarted(self, now_ns: int, *, done: bool) -> None:
        """Take in that the interface was restarted, or that this process may not do so.

        In that case the frames stay, at most those of `STUCK_MS`, and a silent bus is not probed.
        """
        self.unacknowledged = True
        self.refused(now_ns)
        self._can_restart = done
        self._waiting.clear()

    def probe_due(self, now_ns: int) -> bool:
        """Return True if a probe is to show whether the bus carries frames, and count it as sent.

        Of a bus that has carried nothing: as soon as the drive is heard, then every `PROBE_MS`.
        Of a bus that is silent: once, so that it is known whether nobody is there.
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
        """Begin with a newly opened bus; whatever waits from before shows by the next frame."""
        self._waiting.clear()
        self._blocked_ns = 0
