"""`--snapshot SECONDS`: the last seconds in memory, written only when there is a fault.

A fault is: a module goes to FAULT or DAMP, an emergency stop, a steady sender that falls silent (a
dead service publishes no fault), or SIGUSR1. Messages from SECONDS before it to SECONDS after it
are written; another fault extends that. Memory is bounded: the oldest messages are dropped first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Final

import msgspec

from shared.bus import topics
from shared.bus.messages import Mode
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.mcap_log.writer import MessageSource

FAULTS: Final = frozenset((Mode.FAULT, Mode.DAMP))
"""Modes of a joint service that are worth a file."""

STEADY: Final = (topics.JOINT_STATE, topics.PLANNER_STATUS, topics.WRENCH)
"""Senders whose silence is a fault, once they have sent."""

SILENT_NS: Final = NS_PER_S
"""At their rates, 250 messages."""

OVERHEAD: Final = 200
"""Bytes of memory of a message beside its payload: tuple, number, headers."""


class _Event(msgspec.Struct, gc=False):
    mode_after: int


class SnapshotRing:
    """A ring of messages, `seconds` of them; a `MessageSource` of those to be written."""

    def __init__(self, seconds: float, most_bytes: int, keys: Mapping[str, Topic]) -> None:
        self.dropped = 0
        """Messages younger than `seconds` that memory had no room for."""
        self.reason = ""
        """Description of the newest fault."""
        self.memory = 0
        """Bytes of memory in use, about."""
        self._ring: deque[tuple[str, bytes, int]] = deque()
        self._most = most_bytes
        self._span_ns = round(seconds * NS_PER_S)
        self._until_ns: int | None = None
        watched = (topics.JOINT_EVENT, topics.ESTOP, *STEADY)
        self._watched = {key: topic for key, topic in keys.items() if topic in watched}
        self._keys = {key: key for key in keys}
        """One string for all messages of a key."""
        self._heard: dict[str, int] = {}
        self._decode = msgspec.json.Decoder(_Event).decode

    def __len__(self) -> int:
        """Return the number of messages in the ring."""
        return len(self._ring)

    @property
    def writing(self) -> bool:
        """True from a fault on until all that belongs to it was taken."""
        return self._until_ns is not None

    def take_from(self, source: MessageSource, at_most: int) -> int:
        """Store new messages; return their number."""
        taken = 0
        while taken < at_most and (item := source.take()) is not None:
            taken += 1
            key, payload, received_ns = item
            if (topic := self._watched.get(key)) is not None:
                self._watch(topic, item)
            self._ring.append((self._keys.get(key, key), payload, received_ns))
            self.memory += len(payload) + OVERHEAD
        while self.memory > self._most and self._ring:
            self._pop()
            self.dropped += 1
        return taken

    def trigger(self, reason: str, now_ns: int) -> None:
        """Have the ring written."""
        if self._until_ns is None:
            self._forget_before(now_ns - self._span_ns)
        self._until_ns = now_ns + self._span_ns
        self.reason = reason

    def pass_time(self, now_ns: int) -> None:
        """Detect silent senders, and drop messages older than the ring's length."""
        for key, heard_ns in list(self._heard.items()):
            if now_ns - heard_ns > SILENT_NS:
                del self._heard[key]  # until it sends again
                self.trigger(f"{key} is silent", now_ns)
        if self._until_ns is None:
            self._forget_before(now_ns - self._span_ns)
        elif now_ns > self._until_ns and not (self._ring and self._ring[0][2] <= self._until_ns):
            self._until_ns = None

    def take(self) -> tuple[str, bytes, int] | None:
        """Return the oldest message that is to be written, or None."""
        ring = self._ring
        if self._until_ns is None or not ring or ring[0][2] > self._until_ns:
            return None
        return self._pop()

    def _watch(self, topic: Topic, item: tuple[str, bytes, int]) -> None:
        key, payload, received_ns = item
        if topic is topics.ESTOP:
            self.trigger("emergency stop", received_ns)
        elif topic is topics.JOINT_EVENT:
            try:
                mode = self._decode(payload).mode_after
            except (msgspec.DecodeError, UnicodeDecodeError):
                return
            if mode in FAULTS:
                self.trigger(f"{key}: {Mode(mode).name}", received_ns)
        else:
            self._heard[key] = received_ns

    def _forget_before(self, oldest_ns: int) -> None:
        while self._ring and self._ring[0][2] < oldest_ns:
            self._pop()

    def _pop(self) -> tuple[str, bytes, int]:
        item = self._ring.popleft()
        self.memory -= len(item[1]) + OVERHEAD
        return item
