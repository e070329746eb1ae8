"""What passes on the bus: rate, spacing, age and size of the messages of each key."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Final

import msgspec
from rich import box
from rich.table import Table

from shared.bus.session import Session
from shared.bus.topics import several_may_write
from shared.clock import NS_PER_MS
from shared.mcap_log.sequence_stats import KeyCount
from tools.topic_keys import TopicKey, sender_of

POLL_S: Final = 0.001
"""Bounds how late a message is seen, and so the spacing's error."""
LINKS_S: Final = 0.3
"""Time in which links to the services form."""


class _Numbering(msgspec.Struct, gc=False):
    """What is read of a message."""

    t_ns: int
    seq: int


class _KeyTraffic:
    """The messages of one key in a window of time: `count`, and their `size`, bytes."""

    def __init__(self, key: TopicKey, *, here: bool = True) -> None:
        """Count from now on; `here`: the sender is on this host, and has its clock."""
        self.key = key
        self._here = here
        self._counted = KeyCount(several=several_may_write(f"xrl/robot/{key.name}"))
        self._last_ns: int | None = None
        self.begin()

    def begin(self) -> None:
        """Begin a new window."""
        self.count, self.size, self._lost_before = 0, 0, self._counted.missing
        self._gaps: list[int] = []
        self._ages: list[int] = []

    def feed(self, payload: bytes, now_ns: int) -> None:
        """Take a message; what is none is counted with its size only."""
        self.count += 1
        self.size += len(payload)
        if self._last_ns is not None:
            self._gaps.append(now_ns - self._last_ns)
        self._last_ns = now_ns
        try:
            head = _NUMBERINGS.decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError):
            return
        self._counted.feed(head.seq)
        if self._here:
            self._ages.append(now_ns - head.t_ns)

    @property
    def lost(self) -> int:
        """Messages in the window that the numbers of the senders jump over."""
        return self._counted.missing - self._lost_before

    @property
    def gaps_ms(self) -> tuple[float, float] | None:
        """Median and longest time between two messages, ms; None: fewer than two."""
        return _spread_ms(self._gaps)

    @property
    def ages_ms(self) -> tuple[float, float] | None:
        """Median and largest age at reception, ms; None where the sender is not on this host."""
        return _spread_ms(self._ages)


_NUMBERINGS: Final = msgspec.json.Decoder(_Numbering)


def _spread_ms(values: Sequence[int]) -> tuple[float, float] | None:
    if not values:
        return None
    return sorted(values)[len(values) // 2] / NS_PER_MS, max(values) / NS_PER_MS


class Traffic:
    """Receives keys of a bus, undecoded."""

    def __init__(
        self, session: Session, keys: Iterable[TopicKey], elsewhere: Collection[str] = ()
    ) -> None:
        self.keys = {
            key.topic.key(session.robot, key.module): _KeyTraffic(
                key, here=not elsewhere or sender_of(key.topic, key.module) not in {"", *elsewhere}
            )
            for key in keys
        }
        self._stream = session.stream(list(self.keys))

    def listen(self, seconds: float, left: Callable[[], bool] = lambda: False) -> float:
        """Receive one window; return how long it was, s."""
        for traffic in self.keys.values():
            traffic.begin()
        began = time.monotonic()
        while time.monotonic() - began < seconds and not left():
            while (sample := self._stream.take()) is not None:
                key, payload, now_ns = sample
                self.keys[key].feed(payload, now_ns)
            time.sleep(POLL_S)
        return time.monotonic() - began


def traffic_table(traffic: Traffic, window_s: float) -> Table:
    """Return one row for each key; the window is in s of the fleet's clock."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("topic", no_wrap=True)
    for heading in ("Hz", "apart ms", "age ms", "bytes", "kB/s", "lost"):
        table.add_column(heading, justify="right", no_wrap=True)
    for one in traffic.keys.values():
        table.add_row(one.key.name, *_cells(one, window_s))
    return table


def _cells(one: _KeyTraffic, window_s: float) -> list[str]:
    """Return rate and nominal rate, spacing and age (median, largest), size, flow and losses."""
    nominal = f"/{one.key.topic.rate_hz:g}" if one.key.topic.rate_hz else ""
    return [
        f"{one.count / window_s:.0f}{nominal}" if one.count else f"-{nominal}",
        _two(one.gaps_ms),
        _two(one.ages_ms),
        f"{one.size / one.count:.0f}" if one.count else "-",
        f"{one.size / window_s / 1e3:.1f}" if one.count else "-",
        str(one.lost) if one.lost else "",
    ]


def _two(values: tuple[float, float] | None) -> str:
    return "-" if values is None else f"{values[0]:.1f}/{values[1]:.1f}"
