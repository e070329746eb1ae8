"""Re-execution of a joint service, cycle by cycle: the service's loop with inputs from the log."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import msgspec

from services.joint.drive_manager import DriveManager, DriveManagerState
from services.joint.drivers.base import DriveReading
from services.joint.loop import JointLoop, JointPorts
from services.joint.neighbours import NeighbourView
from shared.bus import topics
from shared.bus.messages import (
    DriveStatus,
    Estop,
    JointCommand,
    JointEvent,
    JointState,
    Message,
)
from shared.bus.traces import CycleTrace, JointTrace
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.state import copied
from tools.logs.reexecution.compare import ReexecutionResult, memory_of
from tools.logs.run_log import RunLog

_encode: Final = msgspec.json.Encoder().encode
_STATUS: Final = {int(status): status for status in DriveStatus}


class _Cycle:
    """Inputs and outputs of one cycle: drive, ports, neighbours and clock of the loop."""

    def __init__(self) -> None:
        self.trace: CycleTrace | None = None
        self.command: JointCommand | None = None
        self.refused = 0
        self.sent: list[JointState | JointEvent] = []

    def now(self) -> CycleTrace:
        assert self.trace is not None  # noqa: S101 - set before each cycle
        return self.trace

    def clock(self) -> int:
        return self.now().now_ns

    def read(self, timeout_s: float) -> DriveReading | None:  # noqa: ARG002
        return _reading(self.now())

    def take(self) -> JointCommand | None:
        return self.command

    def ended(self) -> int:
        return self.now().ended

    def view(self, now_ns: int) -> NeighbourView:  # noqa: ARG002
        c = self.now()
        return NeighbourView(c.below if c.knows_below else None, c.sinks, c.stiffen)

    def put(self, message: JointState | JointEvent, /) -> bool:
        self.sent.append(message)
        return True

    def write(self, _: object) -> None:
        """Do nothing, because the outputs to drive and neighbours are already recorded."""

    write_torque = set_position = write

    def arm(self, *, onboard: bool) -> None:
        """Do nothing."""

    def idle(self) -> None:
        """Do nothing."""

    clear_errors = idle

    def close(self) -> None:
        """Do nothing."""


class _Stops:
    def __init__(self, cycle: _Cycle) -> None:
        self._cycle = cycle

    def take(self) -> Estop | None:
        c = self._cycle.now()
        return Estop(t_ns=c.now_ns, seq=0, source="") if c.estop else None


class JointExecution:
    """The re-executed joint service of one module, from its recorded traces."""

    def __init__(self, robot: RobotConfig, name: str, outcome: ReexecutionResult) -> None:
        """Prepare to execute the module `name` of a robot; `run` fills in `outcome`."""
        self._robot, self._name, self.outcome = robot, name, outcome
        self._cycle = _Cycle()
        self._loop: JointLoop | None = None
        self._expected = 0

    def run(self, log: RunLog) -> Iterator[tuple[str, Message]]:
        """Execute a run, or its next part, in every cycle with complete inputs.

        Yields each output that the log also contains, with its full key.
        """
        self._load(log)
        traces: list[JointTrace] = log.messages(topics.JOINT_TRACE, self._name)
        received = log.received_ns(topics.JOINT_TRACE, self._name)
        for trace, received_ns in zip(traces, received, strict=True):
            if not log.begin_ns <= received_ns < log.end_ns:
                continue
            if trace.seq != self._expected:
                self._loop = None  # the log lacks traces, or the service restarted
            self._expected = trace.seq + 1
            if trace.snapshot:
                self._remember(trace)
            for cycle in trace.cycles:
                if self._loop is None or not self._receive(cycle):
                    self._loop = None
                    self.outcome.skipped += 1
                else:
                    yield from self._execute(self._loop, cycle)

    def _load(self, log: RunLog) -> None:
        name, self._log_robot = self._name, log.robot
        commands: list[JointCommand] = log.messages(topics.JOINT_COMMAND, name)
        self._commands = {(command.session, command.seq): command for command in commands}
        states: list[JointState] = log.messages(topics.JOINT_STATE, name)
        self._states = {(state.t_ns, state.cycle): state for state in states}
        self._events = {event.t_ns: event for event in log.messages(topics.JOINT_EVENT, name)}

    def snapshot(self) -> DriveManagerState | None:
        """Return the service's present state, or None if it cannot be executed."""
        return None if self._loop is None else copied(self._loop.module.state)

    def _remember(self, trace: JointTrace) -> None:
        """Start from a recorded snapshot, or compare the present state with it."""
        if self._loop is None:
            module = DriveManager(self._robot, self._name)
            module.state = memory_of(trace.snapshot, DriveManagerState)
            self._loop = self._loop_of(module)
            self.outcome.starts += 1
            return
        if self.outcome.exact:
            computed = msgspec.structs.replace(
                trace, snapshot=_encode(self._loop.module.state).decode()
            )
            self._compare("trace", self._loop.module.state.controller.cycle, trace, computed)

    def _loop_of(self, module: DriveManager) -> JointLoop:
        self._cycle = cycle = _Cycle()
        ports = JointPorts(
            commands=cycle,
            estops=_Stops(cycle),
            states=cycle,
            events=cycle,
            traces=None,
            planner=cycle,
        )
        return JointLoop(self._robot, module, cycle, ports, neighbours=cycle, clock=cycle.clock)

    def _receive(self, trace: CycleTrace) -> bool:
        """Set the inputs of a cycle; return False if the log lacks its command."""
        cycle = self._cycle
        cycle.trace, cycle.command = trace, None
        cycle.refused += trace.malformed
        if trace.command_seq >= 0:
            cycle.command = self._commands.get((trace.session, trace.command_seq))
            if cycle.command is None:
                self.outcome.lost_inputs += 1
                return False
        return True

    def _execute(self, loop: JointLoop, trace: CycleTrace) -> Iterator[tuple[str, Message]]:
        step, controller, sent = loop.cycle(), loop.module.state.controller, self._cycle.sent
        self.outcome.ticks += 1
        drive_command = step.command.value
        if drive_command != trace.drive_command:
            computed = msgspec.structs.replace(trace, drive_command=drive_command)
            self._compare("trace", controller.cycle, _single(trace), _single(computed))
        for message in sent:
            recorded: Message | None
            if isinstance(message, JointState):
                topic = topics.JOINT_STATE
                recorded = self._states.get((message.t_ns, message.cycle))
            else:
                topic = topics.JOINT_EVENT
                recorded = self._events.get(message.t_ns)
            if recorded is not None:
                what = topic.name.rpartition("/")[2]
                self._compare(what, controller.cycle, recorded, message)
                yield topic.key(self._log_robot, self._name), message
        sent.clear()

    def _compare(self, what: str, tick: int, recorded: Message, recomputed: Message) -> None:
        key = f"joint/{self._name}/{what}"
        self.outcome.comparison.take(key, tick, recorded, recomputed)


def _single(cycle: CycleTrace) -> JointTrace:
    return JointTrace.of([cycle], seq=0, snapshot="")


def _reading(c: CycleTrace) -> DriveReading | None:
    """Return the drive's sample of a cycle.

    Raises:
        RunError: its status is not valid.
    """
    if c.sampled_ns < 0:
        return None
    status = _STATUS.get(c.status)
    if status is None:
        raise RunError(
            f"trace of the cycle at {c.now_ns} ns: drive status {c.status}, but the maximum is "
            f"{max(_STATUS)}; the record is damaged"
        )
    return DriveReading(
        c.sampled_ns,
        c.pos,
        c.vel,
        status,
        c.error,
        c.carried if c.carries else None,
        c.encoder_zero if c.encoder_zero[0] >= 0.0 else None,
        c.fet_celsius if any(c.fet_celsius) else None,
        c.motor_celsius if any(c.motor_celsius) else None,
        supply_v=c.supply_v,
    )
