"""Publishers and subscribers of the bus, made by `shared.bus.session.Session`.

On the control path (`Publisher.put`, `Latest.take`) nothing blocks or raises. A message that cannot
be sent or decoded is counted, and the age of its receiver's newest message grows.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Container, Mapping, Sequence
from functools import partial
from typing import Final, Generic, TypeAlias, TypeVar

import msgspec
import zenoh

from shared import log
from shared.bus.codec import Decoder, encode
from shared.bus.messages import Message
from shared.bus.traces import Batch
from shared.clock import NS_PER_MS, now_ns
from shared.exceptions import EncodeError

M = TypeVar("M", bound=Message)
T = TypeVar("T")
Subscriber: TypeAlias = "zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]"
_Put: TypeAlias = Callable[[bytes], None]

_BATCH_MAX: Final = 64
"""Maximum number of messages in a batch that no message closes."""


class BatchSender:
    """Sender of a copy of a service's messages to the recorder, many messages at a time.

    If the recorder subscribed to each key, each message would wake it, and Zenoh's threads on both
    sides.
    """

    def __init__(self, put: _Put) -> None:
        self._put = put
        self._seq = 0
        self._messages: list[tuple[str, msgspec.Raw]] = []

    def also(self, key: str, put: _Put, *, closes: bool) -> _Put:
        """Return a `put` for one key that also adds the payload to the batch.

        With `closes`, each payload completes the batch, which is then sent.
        """
        messages = self._messages

        def put_and_add(payload: bytes) -> None:
            put(payload)
            messages.append((key, msgspec.Raw(payload)))
            if closes or len(messages) == _BATCH_MAX:
                self.send()

        return put_and_add

    def send(self) -> None:
        """Send the collected messages, if any."""
        if self._messages:
            self._seq += 1
            batch = Batch(t_ns=now_ns(), seq=self._seq, messages=tuple(self._messages))
            self._messages.clear()
            self._put(encode(batch))


class Publisher(Generic[T]):
    """Publisher of one key."""

    def __init__(
        self, publisher: zenoh.Publisher, encoded: Callable[[T], bytes], put: _Put
    ) -> None:
        self._publisher, self._put, self._encoded = publisher, put, encoded
        self.failed = 0
        """Number of unsent messages: a value could not be encoded, or the session was closed."""
        self._has_reported = False

    def put(self, message: T) -> bool:
        """Send a message; return False and count it if it cannot be sent.

        Never blocks and never raises. If a subscriber's queue is full, the message is dropped for
        that subscriber only and not counted. A message that cannot be encoded is a bug of the
        sender. The first one is logged by a separate thread, because logging may block.
        """
        try:
            self._put(self._encoded(message))
        except zenoh.ZError:
            self.failed += 1
            return False
        except EncodeError as error:
            self.failed += 1
            if not self._has_reported:
                self._has_reported = True
                line = ("%s", str(error))
                threading.Thread(target=log.get("xrl").error, args=line, daemon=True).start()
            return False
        return True


class RawPublisher(Publisher[bytes]):
    """Publisher of encoded payloads on one key: for log playback, never for a service."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        super().__init__(publisher, bytes, put_with_key(publisher))

    @property
    def matched(self) -> bool:
        """True if the key has a subscriber; for display."""
        try:
            return bool(self._publisher.matching_status.matching)  # type: ignore[attr-defined]  # zenoh's stub
        except zenoh.ZError:
            return False


class Latest(Generic[M]):
    """Newest message of one key."""

    def __init__(self, subscriber: Subscriber, message_type: type[M]) -> None:
        self._subscriber = subscriber  # dropping it would end the subscription
        self._try_recv = subscriber.handler.try_recv
        self._attachment = _attachment(str(subscriber.key_expr))
        self._decoder = Decoder(message_type)
        self._misdelivered = 0

    @property
    def refused(self) -> int:
        """Number of payloads that could not be decoded, or were sent to another key."""
        return self._decoder.refused + self._misdelivered

    def take(self) -> M | None:
        """Return the newest message if it was not taken before, else None; never blocks.

        A payload that cannot be decoded is counted in `refused` and gives None.
        """
        payload = self._payload()
        return None if payload is None else self._decoder.decode(payload)

    def _payload(self) -> bytes | None:
        """Return the newest payload, or None if there is none or it was sent to another key."""
        sample = self._try_recv()
        if sample is None:
            return None
        if sample.attachment != self._attachment:
            self._misdelivered += 1
            return None
        return sample.payload.to_bytes()


class LatestInBatch(Latest[M]):
    """Newest message of one key, from the recorder's batches."""

    def __init__(self, batches: Subscriber, key: str, message_type: type[M]) -> None:
        super().__init__(batches, message_type)
        self._key, self._batches = key, Decoder(Batch)

    def take(self) -> M | None:
        """Return the key's newest message in the newest batch, or None.

        None if the batch was taken before, is malformed or has no message of the key.
        """
        payload = self._payload()
        batch = None if payload is None else self._batches.decode(payload)
        for key, payload in reversed(() if batch is None else batch.messages):
            if key == self._key:
                return self._decoder.decode(bytes(payload))
        return None


class Stream:
    """Undecoded samples of some keys, for the recorder and for tools."""

    def __init__(self, subscribers: Sequence[Subscriber]) -> None:
        self._subscribers = deque(subscribers)
        self.misdelivered = 0
        """Number of dropped samples that arrived under a key to which they were not sent."""

    def take(self) -> tuple[str, bytes, int] | None:
        """Return (key, payload, time in monotonic ns) of the oldest sample, or None.

        The time is that of this call, not of the arrival. Samples are in order only within one key
        expression. Never blocks. A full buffer drops its oldest samples; the messages' sequence
        numbers show the loss.
        """
        for _ in range(len(self._subscribers)):
            self._subscribers.rotate(-1)  # in turns, so that no busy key starves another
            sample = self._subscribers[0].try_recv()
            if sample is None:
                continue
            key = str(sample.key_expr)
            if sample.attachment == _attachment(key):
                return key, sample.payload.to_bytes(), now_ns()
            self.misdelivered += 1
        return None


class Recording(Stream):
    """Undecoded messages for the log, unpacked from their batches."""

    def __init__(
        self, subscribers: Sequence[Subscriber], keys_by_batch: Mapping[str, Container[str]]
    ) -> None:
        """Store the subscribers and, by batch key, the keys that its batches may contain."""
        super().__init__(subscribers)
        self._keys_by_batch = keys_by_batch
        self._decoder = Decoder(Batch)
        self._waiting: deque[tuple[str, bytes, int]] = deque()

    def take(self) -> tuple[str, bytes, int] | None:
        """Return (key, payload, time in monotonic ns) of the oldest message, or None.

        The time is rounded up to a millisecond, because equal times make a log shorter. A message
        that the batch's sender may not put is dropped. A malformed batch is returned as it is, and
        the recorder counts its key as unknown.
        """
        while not self._waiting:
            sample = super().take()
            if sample is None:
                return None
            name, payload, at_ns = sample
            at_ns = -(-at_ns // NS_PER_MS) * NS_PER_MS
            if name not in self._keys_by_batch:
                return name, payload, at_ns
            allowed = self._keys_by_batch[name]
            batch = self._decoder.decode(payload)
            if batch is None:
                return name, payload, at_ns
            self._waiting.extend(
                (k, bytes(raw), at_ns) for k, raw in batch.messages if k in allowed
            )
        return self._waiting.popleft()


def _attachment(key: str) -> zenoh.ZBytes:
    """Return the attachment of every message: the key that it was sent to.

    Zenoh 1.10.2 may deliver a message under another key. A process without CPU time for longer
    than the lease is redialled; for a moment it still uses the old link's numbers for keys, and its
    peer resolves them by the new link's. Two modules' states or commands would then be swapped.
    """
    return zenoh.ZBytes(key.encode())


def put_with_key(publisher: zenoh.Publisher) -> _Put:
    """Return the `put` that attaches the publisher's key."""
    return partial(publisher.put, attachment=_attachment(str(publisher.key_expr)))
