"""The injector's loop: let through what is due, do what is asked, begin and end what is due."""

from __future__ import annotations

from typing import Final

from services.injector.commands import Orders
from services.injector.event_loop import SocketWatch
from services.injector.relay import Relay
from shared.clock import NS_PER_S, machine_s, now_ns
from shared.impairment_schedule import ImpairmentSchedule
from shared.process import StopFlag

LOOK_S: Final = 0.02
"""Longest wait: the stop flag is looked at so often. What is told then still has to find the
recorder, which listens for 0.1 s after its own stop."""


def run(
    watch: SocketWatch, relay: Relay, orders: Orders, injections: ImpairmentSchedule, stop: StopFlag
) -> None:
    """Run until `stop`."""
    while not stop:
        ready = watch.wait(_patience_s(relay, injections))
        at_ns = now_ns()
        relay.let_out_due(at_ns)
        for call, events in ready:
            call(events, at_ns)
        relay.give_up(at_ns)
        if injections.advance(at_ns, at_ns) or orders.changed:
            orders.changed = False
            relay.release(at_ns)


def _patience_s(relay: Relay, injections: ImpairmentSchedule) -> float:
    """Return how long there is nothing to do."""
    at_ns = now_ns()
    due_ns = relay.next_ns()
    next_ns = injections.next_due if due_ns is None else min(due_ns, injections.next_due)
    return max(0.0, min(LOOK_S, machine_s((next_ns - at_ns) / NS_PER_S)))
