"""Executes the planner again, tick by tick."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import msgspec

from services.planner.controller import Controller
from services.planner.intents import OperatorRequest
from services.planner.planner import Planner, PlannerState
from shared.bus import topics
from shared.bus.messages import JointCommand, Message, PlannerStatus
from shared.bus.traces import PlannerCheckpoint
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.logs.reexecution.found import BySeq
from tools.logs.reexecution.memory import memory_of
from tools.logs.reexecution.outcome import ReexecutionResult
from tools.logs.run_log import RunLog

_encode: Final = msgspec.json.Encoder().encode


class PlannerExecution:
    """The planner, re-executed from its statuses: each lists the inputs of its tick."""

    def __init__(
        self,
        robot: RobotConfig,
        outcome: ReexecutionResult,
        controller: Callable[[], Controller] | None = None,
    ) -> None:
        """Take the robot to execute with, what to fill in, and somebody's own controller."""
        self._robot, self._outcome, self._controller = robot, outcome, controller
        self._planner: Planner | None = None
        self._last: PlannerStatus | None = None
        self._state_seq: list[int] = []
        self._wrench_seq = -1
        self._attitude_seq = -1

    def run(self, log: RunLog) -> Iterator[tuple[str, Message]]:
        """Execute every tick that can be; yield module (or "") and what comes out.

        Args:
            log: a run, or its parts one after the other.
        """
        self._load(log)
        statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
        received = log.received_ns(topics.PLANNER_STATUS)
        for status, received_ns in zip(statuses, received, strict=True):
            if not log.begin_ns <= received_ns < log.end_ns:
                continue
            last, self._last = self._last, status
            if last is not None and not _follows(status, last):
                self._planner = None  # another planner, or ticks that the log lacks
            if self._planner is None or not self._receive(self._planner, status):
                self._planner = None
                self._outcome.skipped += 1
                self._begin(status)
                continue
            yield from self._tick(self._planner, status)

    def _load(self, log: RunLog) -> None:
        """Look up what the ticks of a part took and sent."""
        snapshots: list[PlannerCheckpoint] = log.messages(topics.PLANNER_CHECKPOINT)
        self._snapshots = {(snapshot.session, snapshot.t_ns): snapshot for snapshot in snapshots}
        self._states = [BySeq(log.messages(topics.JOINT_STATE, name)) for name in MODULES]
        self._wrenches = BySeq(log.messages(topics.WRENCH))
        self._attitudes = BySeq(log.messages(topics.ATTITUDE))
        self._commands: dict[tuple[str, int, int], JointCommand] = {
            (name, command.session, command.seq): command
            for name in MODULES
            for command in log.messages(topics.JOINT_COMMAND, name)
        }

    def snapshot(self) -> tuple[int, PlannerState] | None:
        """Return the planner's session and present state; None while it cannot be executed."""
        planner = self._planner
        return None if planner is None else (planner.session, planner.snapshot())

    def _begin(self, status: PlannerStatus) -> None:
        """Go on from the memory after this tick, if the log has it."""
        snapshot = self._snapshots.get((status.session, status.t_ns))
        if snapshot is None:
            return
        known = memory_of(snapshot.snapshot, PlannerState)
        controller = self._controller() if self._controller is not None else None
        self._planner = Planner(self._robot, status.session, controller)
        self._planner.restore(known)
        self._state_seq = [-1 if state is None else state.seq for state in known.states]
        self._wrench_seq = known.wrench_seq
        self._attitude_seq = known.attitude_seq
        self._outcome.starts += 1

    def _receive(self, planner: Planner, status: PlannerStatus) -> bool:
        """Give the planner what this tick took; False if the log lacks something of it."""
        for module, seq in enumerate(status.state_seq):
            arrived_ns = status.t_ns - status.state_age_ns[module]
            if seq == self._state_seq[module]:
                continue
            state = self._states[module].at(seq, arrived_ns)
            if state is None:
                self._outcome.lost_inputs += 1
                return False
            planner.receive_state(module, state, arrived_ns)
            self._state_seq[module] = seq
        if status.wrench_seq != self._wrench_seq:
            wrench = self._wrenches.at(status.wrench_seq, status.t_ns)
            if wrench is None:
                self._outcome.lost_inputs += 1
                return False
            planner.receive_wrench(wrench, status.t_ns)
            self._wrench_seq = status.wrench_seq
        if status.attitude_seq != self._attitude_seq:
            attitude = self._attitudes.at(status.attitude_seq, status.t_ns)
            if attitude is None:
                self._outcome.lost_inputs += 1
                return False
            planner.receive_attitude(attitude, status.t_ns)
            self._attitude_seq = status.attitude_seq
        request = OperatorRequest(
            status.assist_requested_n,
            status.shift_requested,
            status.requested_by,
            status.probe_row,
            status.probe,
        )
        planner.receive_request(request)
        return True

    def _tick(self, planner: Planner, status: PlannerStatus) -> Iterator[tuple[str, Message]]:
        outcome, compare = self._outcome, self._outcome.comparison.take
        commands = planner.tick(status.t_ns)
        outcome.ticks += 1
        tick = status.seq
        for name, command in zip(MODULES, commands, strict=False):
            recorded = self._commands.get((name, status.session, command.seq))
            if recorded is not None:
                compare(f"joint/{name}/command", tick, recorded, command)
                yield name, command
        computed = planner.status(
            status.t_ns, status.tick_us
        )  # tick_us is a time that was measured
        compare("planner/status", tick, status, computed)
        yield "", computed
        snapshot = self._snapshots.get((status.session, status.t_ns))
        if snapshot is not None and outcome.exact:
            text = _encode(planner.snapshot()).decode()
            mine_then = msgspec.structs.replace(snapshot, snapshot=text)
            compare("planner/checkpoint", tick, snapshot, mine_then)


def _follows(status: PlannerStatus, last: PlannerStatus) -> bool:
    """Return True for the same planner's next tick; a new session is one more than the last."""
    renewed = status.session == last.session + 1 and status.seq == last.seq + 1
    return renewed or (status.session == last.session and status.seq <= last.seq + 1)
