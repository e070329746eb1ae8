"""Plays a schedule: waits, publishes what is due, obeys keys, and says how it goes."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path
from typing import Final, Protocol

import msgspec

from shared.bus.session import RawPublisher
from shared.clock import NS_PER_MS, NS_PER_S
from tools.logs.playback.reading import Recording
from tools.logs.playback.schedule import Playhead, Schedule, Window
from tools.logs.run_index import further_files
from tools.terminal import Console


class Press(Enum):
    """A key that means something."""

    PAUSE = "space"
    STEP = "right"
    FASTER = "up"
    SLOWER = "down"
    QUIT = "q"


PRESSES: Final = {
    b" ": Press.PAUSE,
    b"q": Press.QUIT,
    b"\x1b[C": Press.STEP,
    b"\x1bOC": Press.STEP,
    b"\x1b[A": Press.FASTER,
    b"\x1bOA": Press.FASTER,
    b"\x1b[B": Press.SLOWER,
    b"\x1bOB": Press.SLOWER,
}
"""By the bytes that a terminal sends."""


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


def introduce(recording: Recording, paths: list[Path], note: str, console: Console) -> None:
    """Print the facts of a log that a person needs before playing it."""
    if note:
        console.print(note, style="dim", soft_wrap=True)
    for path in recording.unfinished:
        words = f"{path}: not finished; plays as far as it goes"
        console.print(words, style="yellow", soft_wrap=True)
    for path in recording.damaged:
        words = f"{path}: parts of it cannot be read and are left out; see `xrl log info`"
        console.print(words, style="yellow", soft_wrap=True)
    if len(paths) == 1 and (others := further_files(paths[0])):
        names = ", ".join(path.name for path in others)
        words = f"further files of this run: {names}; give the directory to play all"
        console.print(words, style="dim", soft_wrap=True)


def where(keys: Sequence[str], robot: str, part: Window, listening: str) -> str:
    """Return one line: what is played, onto which keys."""
    common = keys[0] if len(keys) == 1 else f"{_common(keys)}**"
    length_s = (part.end_ns - 1 - part.start_ns) / NS_PER_S
    line = f"{length_s:.2f} s of {robot}, {len(keys)} keys, onto {common}"
    return f"{line}; subscribers dial {listening}" if listening else line


def _common(keys: Sequence[str]) -> str:
    first, last = min(keys), max(keys)
    same = next((i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)
    return first[: first.rfind("/", 0, same) + 1]


def summary(player: Player, took_s: float) -> str:
    """Return how it went, in one line."""
    stats = player.stats
    keys = sum(1 for count in stats.counts if count)
    line = f"{stats.put} messages on {keys} keys in {took_s:.2f} s"
    if player.schedule.passes:
        line += f", {player.schedule.passes} passes and a part"
    if stats.put:
        mean_ms = stats.late_sum_ns / (stats.put + stats.failed) / NS_PER_MS
        line += f"; late by {mean_ms:.2f} ms on average, {stats.late_max_ns / NS_PER_MS:.1f} ms "
        line += "at most"
    line += f"; {stats.failed} not sent: the session is closed" if stats.failed else "; all sent"
    if stats.dropped:
        line += "; NOT ALL ARRIVED: a subscriber took nothing for 5 s and its link was dropped"
    if not player.heard:
        return f"{line}; nobody listened"
    if stats.unheard:
        line += f"; nobody listened to the first {stats.unheard}: --wait S waits longer"
    return line


class Display:
    """One line on a terminal that is rewritten; nothing on a pipe."""

    def __init__(self, ports: Sequence[RawPublisher]) -> None:
        self._ports = ports
        self._terminal = sys.stdout.isatty()

    def show(self, player: Player) -> None:
        """Write the line."""
        if not self._terminal:
            return
        head, schedule, stats = player.head, player.schedule, player.stats
        line = (
            f"{player.position_ns() / NS_PER_S:8.2f} / {schedule.length_ns / NS_PER_S:.2f} s  "
            f"{head.rate:.3g}x  {stats.put} messages, "
            f"{sum(1 for count in stats.counts if count)} of {len(self._ports)} keys"
        )
        if schedule.passes:
            line += f", pass {schedule.passes + 1}"
        line += ", paused" if head.paused else ""
        line += "" if player.heard else ", nobody listens"
        sys.stdout.write(f"\r\x1b[2K{line}")
        sys.stdout.flush()

    def clear(self) -> None:
        """Take the line away."""
        if self._terminal:
            sys.stdout.write("\r\x1b[2K")
