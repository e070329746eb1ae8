"""Time of a recorded message."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from tools.logs.run_log import RunLog

_CLOCK_NS: Final = NS_PER_S


def stamped(
    log: RunLog, topic: Topic, module: str, *, margins: bool = False
) -> Iterator[tuple[int, Any]]:
    """Yield time, monotonic ns of the recorder's clock, and message of a key.

    The time is the sender's stamp. Where that is more than a second off, because the sender is on
    another host or had none yet, it is the reception, which is up to 20 ms late. `margins` are the
    messages before and behind the part.
    """
    received = log.received_ns(topic, module)
    for at_ns, message in zip(received, log.messages(topic, module), strict=True):
        if margins or log.holds(at_ns):
            alike = abs(at_ns - message.t_ns) <= _CLOCK_NS
            yield (message.t_ns if alike else at_ns), message
