"""Plays a schedule: waits, publishes what is due, obeys keys, reports the time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol

import msgspec

from shared.clock import NS_PER_MS, NS_PER_S
from tools.logs.playback.press import Press
from tools.logs.playback.schedule import Playhead, Schedule

BURST: Final = 256
"""Messages put in one go, when they are late; keys and clock come in between."""
SHOW_NS: Final = 200 * NS_PER_MS
DROPPED_NS: Final = round(4.9 * NS_PER_S)
"""A patient `put` that takes 5 s has dropped the link of a subscriber that takes nothing."""
STEP_NS: Final = 100 * NS_PER_MS
"""A step where no message comes sooner."""
RATE_STEP: Final = 1.1


class Port(Protocol):
    """The way to one key of the bus."""

    def put(self, payload: bytes) -> bool:
        """Send; False if it cannot be sent."""


class KeyboardClock(Protocol):
    """Waits, and returns the keys that were pressed."""

    def wait(self, timeout_s: float) -> list[Press]:
        """Return at the latest after so long."""


class PlaybackStats(msgspec.Struct):
    """Counts of what has been played."""

    put: int = 0
    failed: int = 0
    """Not sent: the session is closed."""
    unheard: int = 0
    """Put before anybody had subscribed."""
    dropped: int = 0
    """Times that a subscriber took nothing for so long that its link was dropped."""
    late_max_ns: int = 0
    """Longest time after its moment that a message went out."""
    late_sum_ns: int = 0
    counts: list[int] = msgspec.field(default_factory=list)
    """Put, by `Entry.key`."""


class ClockMessage(msgspec.Struct, frozen=True):
    """The recorded time, as it is put beside the messages."""

    t_ns: int
    """Recorder's monotonic clock at the position played: what `t_ns` of messages compares to."""
    seq: int


class Player:
    """One play; `run` returns at its end."""

    def __init__(
        self,
        schedule: Schedule,
        head: Playhead,
        ports: Sequence[Port],
        hand: KeyboardClock,
        *,
        now_ns: Callable[[], int],
        show: Callable[[], None],
        listening: Callable[[], bool] = lambda: True,
        clock: Port | None = None,
        clock_hz: float = 0.0,
    ) -> None:
        self.schedule, self.head = schedule, head
        self.stats = PlaybackStats(counts=[0] * len(ports))
        self._puts = [port.put for port in ports]
        self._hand, self._now_ns, self._show = hand, now_ns, show
        self._listening = listening
        self.heard = False
        """Somebody has subscribed, as far as has been looked."""
        self._clock = clock
        self._clock_period_ns = round(NS_PER_S / clock_hz) if clock_hz else 0
        self._clock_due_ns = self._show_due_ns = now_ns()
        self._clock_seq = 0
        self._quit = False

    def position_ns(self) -> int:
        """Return the time played so far, from the start of this pass."""
        return self.schedule.elapsed_ns(self.head.position(self._now_ns()))

    def run(self) -> None:
        """Play until the last message is out, or somebody quits."""
        while not self._quit and self.schedule.next_ns() is not None:
            self._tell_time()
            self._put_due()
            if self._now_ns() >= self._show_due_ns:
                self._show()
                self._show_due_ns = self._now_ns() + SHOW_NS
            for press in self._hand.wait(self._patience_s()):
                self._obey(press)
        self._show()

    def _put_due(self) -> None:
        """Publish what is due; late messages go at once, in order."""
        schedule, head, stats = self.schedule, self.head, self.stats
        self.heard = self.heard or self._listening()
        for _ in range(BURST):
            position = schedule.next_ns()
            due_ns = None if position is None else head.due_ns(position)
            now_ns = self._now_ns()
            if due_ns is None or due_ns > now_ns:
                return
            late_ns = now_ns - due_ns
            stats.late_sum_ns += late_ns
            if late_ns > stats.late_max_ns:
                stats.late_max_ns = late_ns
            self._put_next()

    def _put_next(self) -> None:
        entry, stats, began_ns = self.schedule.pop(), self.stats, self._now_ns()
        if self._puts[entry.key](entry.payload):
            stats.put += 1
            stats.counts[entry.key] += 1
            stats.unheard += not self.heard
            stats.dropped += self._now_ns() - began_ns > DROPPED_NS
        else:
            stats.failed += 1

    def _tell_time(self) -> None:
        """Put the recorded time if it is due; moments that were missed are left out."""
        if self._clock is None:
            return
        now_ns = self._now_ns()
        if now_ns < self._clock_due_ns:
            return
        missed = (now_ns - self._clock_due_ns) // self._clock_period_ns
        self._clock_due_ns += (missed + 1) * self._clock_period_ns
        recorded_ns = self.schedule.recorded_ns(self.head.position(now_ns))
        self._clock.put(msgspec.json.encode(ClockMessage(recorded_ns, self._clock_seq)))
        self._clock_seq += 1

    def _patience_s(self) -> float:
        """Return how long there is nothing to do."""
        position = self.schedule.next_ns()
        if position is None or self._quit:
            return 0.0
        due = [self._show_due_ns]
        message_ns = self.head.due_ns(position)
        if message_ns is not None:
            due.append(message_ns)
        if self._clock is not None:
            due.append(self._clock_due_ns)
        return max(0, min(due) - self._now_ns()) / NS_PER_S

    def _obey(self, press: Press) -> None:
        head, now_ns = self.head, self._now_ns()
        if press is Press.QUIT:
            self._quit = True
        elif press is Press.PAUSE:
            if head.paused:
                head.resume(now_ns)
            else:
                head.pause(now_ns)
        elif press is Press.STEP and head.paused:
            self._step()
        elif press is Press.FASTER:
            head.change_rate(now_ns, head.rate * RATE_STEP)
        elif press is Press.SLOWER:
            head.change_rate(now_ns, head.rate / RATE_STEP)
        self._show_due_ns = now_ns

    def _step(self) -> None:
        """Go to the next message and put it, or on by `STEP_NS` if it is farther away."""
        position = self.schedule.next_ns()
        here_ns = self.head.position(self._now_ns())
        if position is None or position > here_ns + STEP_NS:
            self.head.step(here_ns + STEP_NS)
        else:
            self.head.step(position)
            self._put_next()
