"""Loop of the proxy: forwards due batches, executes commands, starts and ends impairments."""

from __future__ import annotations

from typing import Final

from services.network_proxy.control import CommandHandler
from services.network_proxy.relay import Relay
from services.network_proxy.sockets import SocketWatch
from shared.clock import NS_PER_S, machine_s, now_ns
from shared.network.impairment_schedule import ImpairmentSchedule
from shared.process import StopFlag

LOOK_S: Final = 0.02
"""Maximum wait before the stop flag is checked, s. It is short, so that the last events reach the
recorder, which records for 0.1 s after its own stop.
"""


def run(
    watch: SocketWatch,
    relay: Relay,
    commands: CommandHandler,
    impairments: ImpairmentSchedule,
    stop: StopFlag,
) -> None:
    """Run until `stop` is set."""
    while not stop:
        ready = watch.wait(_patience_s(relay, impairments))
        at_ns = now_ns()
        relay.release_due(at_ns)
        for call, events in ready:
            call(events, at_ns)
        relay.part_stuck(at_ns)
        if impairments.advance(at_ns, at_ns) or commands.changed:
            commands.changed = False
            relay.release_held(at_ns)


def _patience_s(relay: Relay, impairments: ImpairmentSchedule) -> float:
    """Return the time until the next action, s."""
    at_ns = now_ns()
    due_ns = relay.next_ns()
    next_ns = impairments.next_due if due_ns is None else min(due_ns, impairments.next_due)
    return max(0.0, min(LOOK_S, machine_s((next_ns - at_ns) / NS_PER_S)))
