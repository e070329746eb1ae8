"""Executes a joint service again, cycle by cycle."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import msgspec

from services.joint.drive_manager import DriveManager, DriveManagerState
from services.joint.drivers.base import DriveReading
from services.joint.neighbours import NeighbourView
from shared.bus import topics
from shared.bus.messages import DriveStatus, JointCommand, JointState, Message
from shared.bus.traces import CycleTrace, JointTrace
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools.logs.reexecution.compare import Comparison
from tools.logs.reexecution.memory import memory_of
from tools.logs.reexecution.outcome import ReexecutionResult
from tools.logs.run_log import RunLog

_encode: Final = msgspec.json.Encoder().encode
_STATUS: Final = {int(status): status for status in DriveStatus}


class JointExecution:
    """One module's service, from its traces."""

    def __init__(self, robot: RobotConfig, name: str, outcome: ReexecutionResult) -> None:
        """Take the robot to execute with, the module's name and what to fill in."""
        self._robot, self._name, self._outcome = robot, name, outcome
        self._module: DriveManager | None = None
        self._expected = 0

    def run(self, log: RunLog) -> Iterator[Message]:
        """Execute every cycle that can be; yield what comes out, where the log has its like.

        Args:
            log: a run, or its parts one after the other.
        """
        self._load(log)
        traces: list[JointTrace] = log.messages(topics.JOINT_TRACE, self._name)
        received = log.received_ns(topics.JOINT_TRACE, self._name)
        for trace, received_ns in zip(traces, received, strict=True):
            if not log.begin_ns <= received_ns < log.end_ns:
                continue
            if trace.seq != self._expected:
                self._module = None  # the log lacks traces in between, or the service restarted
            self._expected = trace.seq + 1
            if trace.snapshot:
                self._remember(trace)
            for cycle in trace.cycles:
                if self._module is None:
                    self._outcome.skipped += 1
                else:
                    yield from self._cycle(self._module, cycle)

    def _load(self, log: RunLog) -> None:
        """Look up what the cycles of a part took and sent."""
        name = self._name
        commands: list[JointCommand] = log.messages(topics.JOINT_COMMAND, name)
        self._commands = {(command.session, command.seq): command for command in commands}
        states: list[JointState] = log.messages(topics.JOINT_STATE, name)
        self._states = {(state.t_ns, state.cycle): state for state in states}
        self._events = {event.t_ns: event for event in log.messages(topics.JOINT_EVENT, name)}

    def snapshot(self) -> DriveManagerState | None:
        """Return the service's present state; None while it cannot be executed."""
        return None if self._module is None else self._module.snapshot()

    def _remember(self, trace: JointTrace) -> None:
        """Go on from a recorded memory, or hold ours to it."""
        if self._module is None:
            self._module = DriveManager(self._robot, self._name)
            self._module.restore(memory_of(trace.snapshot, DriveManagerState))
            self._outcome.starts += 1
            return
        if self._outcome.exact:
            computed = msgspec.structs.replace(
                trace, snapshot=_encode(self._module.snapshot()).decode()
            )
            self._compare("trace", self._module.controller.cycle, trace, computed)

    def _cycle(self, module: DriveManager, cycle: CycleTrace) -> Iterator[Message]:
        c, outcome = cycle, self._outcome
        command = None
        if c.command_seq >= 0:
            command = self._commands.get((c.session, c.command_seq))
            if command is None:
                outcome.lost_inputs += 1
                outcome.skipped += 1
                self._module = None
                return
        if c.malformed:
            module.controller.count_malformed(c.malformed, c.now_ns)
        near = NeighbourView(c.below if c.knows_below else None, c.sinks, c.stiffen)
        step = module.step(c.now_ns, _reading(c), command, c.estop, near)
        controller = module.controller
        outcome.ticks += 1
        drive_command, tau = step.command.value, controller.tau
        if drive_command != cycle.drive_command or tau != cycle.tau:
            computed = msgspec.structs.replace(cycle, drive_command=drive_command, tau=tau)
            self._compare("trace", controller.cycle, _single(cycle), _single(computed))
        if controller.is_state_due:
            state = controller.state(c.now_ns)
            recorded = self._states.get((state.t_ns, state.cycle))
            if recorded is not None:
                self._compare("state", controller.cycle, recorded, state)
                yield state
        if step.event is not None:
            logged = self._events.get(step.event.t_ns)
            if logged is not None:
                self._compare("event", controller.cycle, logged, step.event)
                yield step.event

    def _compare(self, what: str, tick: int, recorded: Message, recomputed: Message) -> None:
        comparison: Comparison = self._outcome.comparison
        comparison.take(f"joint/{self._name}/{what}", tick, recorded, recomputed)


def _single(cycle: CycleTrace) -> JointTrace:
    return JointTrace(t_ns=cycle.now_ns, seq=0, snapshot="", cycles=(cycle,))


def _reading(c: CycleTrace) -> DriveReading | None:
    """Return the drive's sample of a cycle.

    Raises:
        RunError: it has a status that there is not.
    """
    if c.sampled_ns < 0:
        return None
    status = _STATUS.get(c.status)
    if status is None:
        raise RunError(
            f"trace of the cycle at {c.now_ns} ns: drive status {c.status}; there are 0 to "
            f"{max(_STATUS)}: the record is damaged, or of a later version"
        )
    return DriveReading(
        c.sampled_ns,
        c.pos,
        c.vel,
        status,
        c.error,
        c.carried if c.carries else None,
    )
