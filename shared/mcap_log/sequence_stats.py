"""Count lost messages from the sequence numbers of one key. Pure."""

from __future__ import annotations

import msgspec


class KeyCount(msgspec.Struct, gc=False, kw_only=True):
    """Counts of one key; `feed` must receive every sequence number in order of arrival."""

    count: int = 0
    """Received messages."""
    gaps: int = 0
    """Times the sequence jumped forward."""
    missing: int = 0
    """Messages missing in all gaps together."""
    restarts: int = 0
    """Times the sequence did not go up: a new sender counts from 0 again."""
    last_seq: int = -1
    """Newest sequence number; -1 before the first."""
    several: bool = False
    """True if several senders number their messages on this key; losses are then unknown."""

    def feed(self, seq: int) -> None:
        """Count the sequence number of the next message.

        Messages before the first one received are not counted as lost, because the connection is
        made some time after sender and subscriber have started.
        """
        step = seq - self.last_seq
        if step != 1 and self.count and not self.several:
            if step > 1:
                self.gaps += 1
                self.missing += step - 1
            else:
                self.restarts += 1
        self.count += 1
        self.last_seq = seq

    def join(self, later: KeyCount) -> None:
        """Add the counts of a later file of the same run."""
        self.count += later.count
        self.gaps += later.gaps
        self.missing += later.missing
        self.restarts += later.restarts
        self.last_seq = later.last_seq
