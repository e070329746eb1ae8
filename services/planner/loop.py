"""The planner's loop: read six states, compute, publish six commands and a status.

Live, lockstep and re-execution run this loop, each with its own ports and clock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from services.planner.intents import Intents, OperatorRequest
from services.planner.planner import Planner
from shared import log
from shared.bus.messages import (
    Attitude,
    JointCommand,
    JointState,
    OperatorIntent,
    PlannerStatus,
    Wrench,
)
from shared.bus.ports import Inbox, Outbox
from shared.bus.traces import PlannerCheckpoint
from shared.clock import NS_PER_S, NS_PER_US, now_ns, sleep_until
from shared.config.robot_config import RobotConfig
from shared.process import StopFlag


class PlannerPorts(msgspec.Struct, frozen=True):
    """Inputs and outputs of the planner; sequences have one entry per module, as in `MODULES`."""

    states: Sequence[Inbox[JointState]]
    wrench: Inbox[Wrench]
    attitude: Inbox[Attitude]
    request: Callable[[int], OperatorRequest]
    """Returns the operator's request at a time on the planner's clock, ns."""
    commands: Sequence[Outbox[JointCommand]]
    status: Outbox[PlannerStatus]
    checkpoint: Outbox[PlannerCheckpoint] | None
    """None if nothing is recorded for re-execution."""
    announce: Callable[[int], None] | None = None
    """Announces the planner's session, so that joint services on its host detect the planner's
    end."""


def requests_of(
    config: RobotConfig, intents: Inbox[OperatorIntent]
) -> Callable[[int], OperatorRequest]:
    """Return a function of the time, ns, that returns the operator's request."""
    kept = Intents(config.assist)

    def request(now_ns: int) -> OperatorRequest:
        intent = intents.take()
        if intent is not None:
            kept.receive(intent, now_ns)
        return kept.request(now_ns)

    return request


class _Checkpoints:
    """Schedule of the recorded planner states, from which re-execution can start.

    A checkpoint is due after every tick whose number is a power of two, later once a second. The
    first ones are frequent, because the recorder discovers a new planner after a short delay.
    """

    def __init__(self, rate_hz: float) -> None:
        self._every = round(rate_hz)
        self._tick = 0
        self._seq = 0
        self._encode = msgspec.json.Encoder().encode

    def after(self, planner: Planner, now_ns: int) -> PlannerCheckpoint | None:
        """Return the checkpoint after the tick just run, or None if it is not due."""
        self._tick += 1
        tick = self._tick
        first = tick < self._every and tick & (tick - 1) == 0
        if not first and tick % self._every:
            return None
        self._seq += 1
        return PlannerCheckpoint(
            t_ns=now_ns,
            seq=self._seq,
            session=planner.session,
            snapshot=self._encode(planner.state).decode(),
        )


POLL_NS = 200 * NS_PER_US
"""Poll period while expected states are missing, ns."""
FOLLOW_NS = 20 * NS_PER_US
"""ns; maximum delay that a late tick adds to the expected time of the next states, so that one late
tick does not delay the following ones."""
EARLIER_NS, EARLIER_MAX_NS = 40 * NS_PER_US, 400 * NS_PER_US
"""ns; initial and maximum advance of the expected time after a tick whose first poll found all
states, because they may have arrived earlier. The advance doubles with each such tick in a row.
With these values, the last state waits 0.12 ms on average if the arrivals spread over 0.5 ms, at
1.9 polls per tick, and 0.18 ms if they spread over 2 ms."""


class PlannerLoop:
    """Loop that ticks the planner when its six states have arrived, at their rate."""

    def __init__(
        self,
        config: RobotConfig,
        planner: Planner,
        ports: PlannerPorts,
        clock: Callable[[], int] | None = None,
    ) -> None:
        self.planner = planner
        self._ports, self._clock = ports, clock or now_ns
        self._period_ns = round(NS_PER_S / config.planner.rate_hz)
        self._due_ns = self._earlier_ns = 0
        self._checkpoints = _Checkpoints(config.planner.rate_hz)
        self._yielded = False
        self._announced = 0

    def run(self, stop: StopFlag) -> None:
        """Run until `stop` is set."""
        while not stop:
            now = self._clock()
            due = self.receive_states(now)
            if due:
                self.tick(now)
                if self.planner.yields != self._yielded:
                    self._report()
            sleep_until(self._next_look(now, ticked=due))

    def _next_look(self, now: int, *, ticked: bool) -> int:
        """Return the time of the next poll for states, ns, after a poll at `now`.

        Each poll wakes the process with cold caches, so the loop polls once per period, when the
        last state is expected, and then every `POLL_NS`. The expected time follows the arrivals,
        and recovers from an error of a whole period within 15 ticks.
        """
        if not ticked:
            self._earlier_ns = 0
            return now + POLL_NS
        expected = self._due_ns + self._period_ns
        if now - expected > self._period_ns:
            expected = now
        elif self._earlier_ns == 0 or self.planner.compares_arrivals:
            expected = min(now, expected + FOLLOW_NS)
        else:
            expected -= self._earlier_ns
        self._earlier_ns = min(max(EARLIER_NS, 2 * self._earlier_ns), EARLIER_MAX_NS)
        self._due_ns = expected
        if self.planner.compares_arrivals:
            return now + POLL_NS
        return max(now + POLL_NS, expected + self._period_ns)

    def receive_states(self, now: int) -> bool:
        """Receive new states; return True if a tick is due."""
        planner = self.planner
        for module, latest in enumerate(self._ports.states):
            state = latest.take()
            if state is not None:
                planner.receive_state(module, state, now)
        return planner.is_due(now)

    def tick(self, now: int) -> None:
        """Receive the other inputs, run one tick and publish its results."""
        planner, ports = self.planner, self._ports
        if planner.session != self._announced and ports.announce is not None:
            self._announced = planner.session
            ports.announce(planner.session)
        wrench = ports.wrench.take()
        if wrench is not None:
            planner.receive_wrench(wrench, now)
        attitude = ports.attitude.take()
        if attitude is not None:
            planner.receive_attitude(attitude, now)
        planner.receive_request(ports.request(now))
        commands = planner.tick(now)
        for publisher, command in zip(ports.commands, commands, strict=False):
            publisher.put(command)
        ports.status.put(planner.status(now, (self._clock() - now) / NS_PER_US, commands))
        if ports.checkpoint is not None:
            checkpoint = self._checkpoints.after(planner, now)
            if checkpoint is not None:
                ports.checkpoint.put(checkpoint)

    def _report(self) -> None:
        """Log that the planner yields or resumes; it leads in neither state, so logging is safe."""
        self._yielded = self.planner.yields
        log.get("xrl").warning("%s", self.planner.rival or "no other planner leads: resuming")
