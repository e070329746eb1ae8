"""Runs the planner's loop: read six states, compute, publish six commands and a status."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from services.planner.checkpoint import Checkpoints
from services.planner.intents import Intents
from services.planner.planner import EARLY_FRACTION, Planner
from shared import log
from shared.bus.messages import (
    Attitude,
    JointCommand,
    JointState,
    OperatorIntent,
    PlannerStatus,
    Wrench,
)
from shared.bus.session import Latest, Publisher
from shared.bus.traces import PlannerCheckpoint
from shared.clock import NS_PER_S, NS_PER_US, now_ns, sleep_until
from shared.config.robot_config import RobotConfig
from shared.process import StopFlag


class PlannerPorts(msgspec.Struct, frozen=True):
    """The planner's subscribers and publishers; one per module in `MODULES` order."""

    states: Sequence[Latest[JointState]]
    wrench: Latest[Wrench]
    attitude: Latest[Attitude]
    intent: Latest[OperatorIntent]
    commands: Sequence[Publisher[JointCommand]]
    status: Publisher[PlannerStatus]
    checkpoint: Publisher[PlannerCheckpoint]


POLL_NS = 200 * NS_PER_US
"""ns between two polls for states, once they are due."""
REST_FRACTION = 0.9
"""Fraction of a period after the states were due in which no new ones are expected."""
FOLLOW_NS = 50 * NS_PER_US
"""ns by which the time at which states are due follows late ones from tick to tick: a tick that was
held up makes none of the following late."""


class PlannerLoop:
    """Ticks the planner when its six states have arrived, at their rate."""

    def __init__(self, config: RobotConfig, planner: Planner, ports: PlannerPorts) -> None:
        self._planner = planner
        self._ports = ports
        self._period_ns = round(NS_PER_S / config.planner.rate_hz)
        self._due_ns = 0
        self._intents = Intents(config.assist)
        self._checkpoints = Checkpoints(config.planner.rate_hz)
        self._yielded = False

    def run(self, stop: StopFlag) -> None:
        """Run until `stop` is set."""
        while not stop:
            now = now_ns()
            due = self.receive_states(now)
            if due:
                self.tick(now)
            sleep_until(self._next_look(now, ticked=due))

    def _next_look(self, now: int, *, ticked: bool) -> int:
        """Return when to look for states again, ns, after a look `now`.

        It looks once halfway between two ticks. A planner that ticks just before its states arrive
        finds them there. Without that look it found them a period later, when the joint services
        on its processor let it run again, and stayed a period late for up to 0.8 s.
        """
        period = self._period_ns
        if ticked:
            expected = self._due_ns + period + FOLLOW_NS
            self._due_ns = now if now - expected > period else min(now, expected)
        if self._planner.compares_arrivals:
            return now + POLL_NS
        if ticked:
            return now + round(EARLY_FRACTION * period)
        return max(now + POLL_NS, self._due_ns + round(REST_FRACTION * period))

    def receive_states(self, now: int) -> bool:
        """Receive new states; return True if a tick is due."""
        planner = self._planner
        for module, latest in enumerate(self._ports.states):
            state = latest.take()
            if state is not None:
                planner.receive_state(module, state, now)
        return planner.is_due(now)

    def tick(self, now: int) -> None:
        """Receive the other inputs, run one tick and publish its results."""
        planner, ports = self._planner, self._ports
        wrench = ports.wrench.take()
        if wrench is not None:
            planner.receive_wrench(wrench, now)
        attitude = ports.attitude.take()
        if attitude is not None:
            planner.receive_attitude(attitude, now)
        intent = ports.intent.take()
        if intent is not None:
            self._intents.receive(intent, now)
        planner.receive_request(self._intents.request(now))
        for publisher, command in zip(ports.commands, planner.tick(now), strict=False):
            publisher.put(command)
        ports.status.put(planner.status(now, (now_ns() - now) / NS_PER_US))
        checkpoint = self._checkpoints.after(planner, now)
        if checkpoint is not None:
            ports.checkpoint.put(checkpoint)
        if planner.yields != self._yielded:
            self._report()

    def _report(self) -> None:
        """Log that it yields to another planner, or goes on; it leads nobody then."""
        self._yielded = self._planner.yields
        log.get("xrl").warning("%s", self._planner.rival or "no other planner leads: going on")
