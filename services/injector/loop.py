"""The injector's loop: let through what is due, do what is asked, end what is over."""

from __future__ import annotations

import math
import select
from typing import Final

from services.injector.control import Control
from services.injector.relay import Relay
from shared.clock import NS_PER_S, now_ns
from shared.exceptions import ConfigError
from shared.injection import Asked, Begin, Clear, Reply, Request
from shared.injections import Injections
from shared.process import StopFlag

LOOK_S: Final = 0.1
"""Longest wait: the stop flag is looked at so often."""


class Orders:
    """Carries out what is asked on the control socket."""

    def __init__(self, injections: Injections) -> None:
        """Take where it is kept."""
        self._injections = injections
        self.changed = False
        """Something has begun or ended; the loop clears it."""

    def obey(self, request: Request) -> Reply:
        """Carry a request out and tell what is asked for now."""
        at_ns = now_ns()
        try:
            if isinstance(request, Begin):
                inject = request.inject
                if amiss := inject.fault():
                    return Reply(error=amiss)
                lasts_s = math.inf if inject.duration is None else inject.duration
                self._injections.begin(inject.link, inject, at_ns + lasts_s * NS_PER_S, at_ns)
            elif isinstance(request, Clear):
                self._injections.clear(request.link, at_ns)
        except ConfigError as error:
            return Reply(error=f"{error.found}; {error.expected}")
        self.changed = True
        return Reply(asked=tuple(self._asked(at_ns)))

    def _asked(self, at_ns: int) -> list[Asked]:
        rows = []
        for number, row in self._injections.asked.items():
            passed, lost = self._injections.counts(number)
            left_s = None if math.isinf(row.until) else (row.until - at_ns) / NS_PER_S
            rows.append(Asked(number, row.link, row.what.in_words(), left_s, passed, lost))
        return rows


def run(
    relay: Relay, control: Control, orders: Orders, injections: Injections, stop: StopFlag
) -> None:
    """Run until `stop`."""
    while not stop:
        readers = [*relay.readers(), *control.sockets()]
        ready, room, _ = select.select(readers, relay.writers(), [], _patience_s(relay, injections))
        at_ns = now_ns()
        relay.let_out_due(at_ns)
        for end in ready:
            if not control.readable(end):
                relay.readable(end, at_ns)
        for end in room:
            relay.writable(end)
        if injections.end_due(at_ns, at_ns) or orders.changed:
            orders.changed = False
            relay.release()


def _patience_s(relay: Relay, injections: Injections) -> float:
    """Return how long there is nothing to do."""
    at_ns = now_ns()
    due_ns = relay.next_ns()
    waits_s = LOOK_S if due_ns is None else min(LOOK_S, (due_ns - at_ns) / NS_PER_S)
    return max(0.0, min(waits_s, (injections.next_end - at_ns) / NS_PER_S))
