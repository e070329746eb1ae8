"""The planner's loop: read six states, think, publish six commands and a status."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from services.planner.checkpoint import Checkpoints
from services.planner.intents import Intents
from services.planner.planner import Planner
from shared.bus import Latest, Publisher
from shared.clock import NS_PER_S, NS_PER_US, now_ns, sleep_until
from shared.config import RobotConfig
from shared.messages import (
    Attitude,
    JointCommand,
    JointState,
    OperatorIntent,
    PlannerStatus,
    Wrench,
)
from shared.process import StopFlag
from shared.traces import PlannerCheckpoint


class PlannerPorts(msgspec.Struct, frozen=True):
    """The planner's bus ends; per module in `MODULES` order."""

    states: Sequence[Latest[JointState]]
    wrench: Latest[Wrench]
    attitude: Latest[Attitude]
    intent: Latest[OperatorIntent]
    commands: Sequence[Publisher[JointCommand]]
    status: Publisher[PlannerStatus]
    checkpoint: Publisher[PlannerCheckpoint]


POLL_NS = 400 * NS_PER_US
"""Between two looks for states, once they are due."""
REST_SHARE = 0.8
"""Of a period: so long nothing is expected after a tick."""


class PlannerLoop:
    """Ticks the planner as its six states come, at its rate."""

    def __init__(self, config: RobotConfig, planner: Planner, ports: PlannerPorts) -> None:
        self._planner = planner
        self._ports = ports
        self._rest_ns = round(REST_SHARE * NS_PER_S / config.planner.rate_hz)
        self._intents = Intents(config.assist)
        self._checkpoints = Checkpoints(config.planner.rate_hz)

    def run(self, stop: StopFlag) -> None:
        """Run until told to stop."""
        while not stop:
            now = now_ns()
            if self.listen(now):
                self.tick(now)
                sleep_until(now + self._rest_ns)
            else:
                sleep_until(now + POLL_NS)

    def listen(self, now: int) -> bool:
        """Take in new states; return True if it is time to tick."""
        planner = self._planner
        for module, latest in enumerate(self._ports.states):
            state = latest.take()
            if state is not None:
                planner.receive_state(module, state, now)
        return planner.is_due(now)

    def tick(self, now: int) -> None:
        """Think and publish."""
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
        planner.receive_wish(self._intents.wish(now))
        for publisher, command in zip(ports.commands, planner.tick(now), strict=False):
            publisher.put(command)
        ports.status.put(planner.status(now, (now_ns() - now) / NS_PER_US))
        checkpoint = self._checkpoints.after(planner, now)
        if checkpoint is not None:
            ports.checkpoint.put(checkpoint)
