"""How far apart the clocks of hosts are, from when messages were sent and received. Pure.

Each host has a monotonic clock of its own, which counts from its start. A message cannot arrive
before it was sent: if a sends at t_a and b has it at t_b, each on its own clock, then

    t_a + offset_a <= t_b + offset_b

with offset_h what brings the clock of h to that of the reference. Messages in both directions bound
an offset from both sides, and the width between the bounds is the shortest way there and back. That
is true whatever the delays are, and also where they differ by direction, for as long as the clocks
do not drift apart meanwhile. Bounds add up over hosts in between: they are shortest paths (Floyd
and Warshall).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from shared.clock import NS_PER_MS

ONE_CLOCK_NS: Final = 20 * NS_PER_MS
"""Bounds that are so narrow and hold 0 are those of one clock."""
DRIFT_NS: Final = NS_PER_MS
"""Bounds may contradict each other by this much, because clocks drift; beyond it none holds."""
TIME_MAX_NS: Final = 1 << 62
"""More than any monotonic clock shows."""


class OffsetBounds(NamedTuple):
    """What has to be added to a host's times to get the reference's; ns."""

    low_ns: float
    """-inf: the host has received nothing."""
    high_ns: float
    """inf: nothing has been received from it."""

    @property
    def known(self) -> bool:
        """True if it is bounded from both sides."""
        return math.isfinite(self.low_ns) and math.isfinite(self.high_ns)

    @property
    def best_ns(self) -> float:
        """The middle; with one bound only, that one: the shortest delay taken for none.

        Narrow bounds that hold 0 are those of one clock: no two hosts started at the same time to
        some milliseconds. NaN if nothing is known.
        """
        if self.known:
            one = self.low_ns <= 0.0 <= self.high_ns and self.high_ns - self.low_ns < ONE_CLOCK_NS
            return 0.0 if one else 0.5 * (self.low_ns + self.high_ns)
        return next((b for b in (self.high_ns, self.low_ns) if math.isfinite(b)), math.nan)

    @property
    def error_ns(self) -> float:
        """Largest error of `best_ns`; inf if it is not known."""
        return max(self.high_ns - self.best_ns, self.best_ns - self.low_ns)


UNKNOWN: Final = OffsetBounds(-math.inf, math.inf)


class ClockOffsets:
    """Bounds of the offsets between hosts, tightened message by message."""

    def __init__(self, hosts: tuple[str, ...]) -> None:
        self._place = {host: index for index, host in enumerate(hosts)}
        self._most = [[math.inf] * len(hosts) for _ in hosts]
        """[a][b]: offset_a - offset_b is at most this, ns."""

    def heard(self, sender: str, sent_ns: int, receiver: str, received_ns: int) -> None:
        """Take a message: each time is that of the host's own clock; no clock shows huge ones."""
        if max(abs(sent_ns), abs(received_ns)) < TIME_MAX_NS:
            row, column = self._place[sender], self._place[receiver]
            self._most[row][column] = min(self._most[row][column], received_ns - sent_ns)

    def against(self, reference: str) -> dict[str, OffsetBounds]:
        """Return the bounds of each host's offset against a reference, by name.

        Clocks that drift contradict each other a little: the bounds have then changed places, and
        are put back. What contradicts itself by more than that is not known.
        """
        zero = self._place[reference]
        most = self._without_contradictions(zero)
        count = len(most)
        for via in range(count):
            for a in range(count):
                for b in range(count):
                    most[a][b] = min(most[a][b], most[a][via] + most[via][b])
        found = {}
        for host, index in self._place.items():
            low, high = -most[zero][index], most[index][zero]
            if index == zero:
                found[host] = OffsetBounds(0.0, 0.0)
            elif low > high + DRIFT_NS:
                found[host] = UNKNOWN
            else:
                found[host] = OffsetBounds(min(low, high), max(low, high))
        return found

    def _without_contradictions(self, zero: int) -> list[list[float]]:
        """Return the bounds of all pairs, without hosts that contradict themselves.

        A host that restarted meanwhile would bound the others wrongly.
        """
        most = [row.copy() for row in self._most]
        count = len(most)
        wrong = set()
        for a in range(count):
            most[a][a] = 0.0
            for b in range(a):
                if most[a][b] + most[b][a] < -DRIFT_NS:
                    wrong |= {a, b} - {zero}
        for a in wrong:
            for b in range(count):
                if a != b:
                    most[a][b] = most[b][a] = math.inf
        return most
