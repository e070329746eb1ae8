"""Output of a playback: before, during and after it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from shared.bus.session import RawPublisher
from shared.clock import NS_PER_MS, NS_PER_S
from tools.logs.playback.player import Player
from tools.logs.playback.reading import Recording
from tools.logs.playback.schedule import Window
from tools.logs.run_files import further_files
from tools.terminal import Console


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
    """Return one line: what is played, onto which keys.

    Args:
        keys: on the bus.
        robot: of the log.
        part: the part that is played.
        listening: endpoint; empty if there is none.
    """
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
