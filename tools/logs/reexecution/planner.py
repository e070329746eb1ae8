"""Re-execution of the planner, tick by tick: the planner's loop with inputs from the log."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from typing import Final, Generic, TypeVar

import msgspec

from services.planner.controller import Controller
from services.planner.intents import OperatorRequest
from services.planner.loop import PlannerLoop, PlannerPorts
from services.planner.planner import Planner, PlannerState
from shared.bus import topics
from shared.bus.messages import Attitude, Message, PlannerStatus, Wrench
from shared.bus.traces import PlannerCheckpoint
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.state import copied
from tools.logs.reexecution.compare import ReexecutionResult, memory_of
from tools.logs.run_log import RunLog

M = TypeVar("M", bound=Message)
_encode: Final = msgspec.json.Encoder().encode


class BySeq(Generic[M]):
    """Finds a sender's message by its sequence number, which restarts with the sender."""

    def __init__(self, messages: Iterable[M]) -> None:
        self._rows: dict[int, list[M]] = {}
        for message in messages:
            self._rows.setdefault(message.seq, []).append(message)

    def at(self, seq: int, by_ns: int) -> M | None:
        """Return the newest message with this number up to a time, else the oldest, or None."""
        rows = self._rows.get(seq)
        if not rows:
            return None
        return rows[max(0, bisect_right(rows, by_ns, key=lambda row: row.t_ns) - 1)]


class _LoggedInbox(Generic[M]):
    """An inbox with the logged message that was used in this tick."""

    def __init__(self) -> None:
        self.message: M | None = None

    def take(self) -> M | None:
        message, self.message = self.message, None
        return message


class _KeptOutbox(Generic[M]):
    """An outbox that stores the outputs of this tick."""

    def __init__(self) -> None:
        self.messages: list[M] = []

    def put(self, message: M, /) -> bool:
        self.messages.append(message)
        return True


class _Tick:
    """Inputs and outputs of one tick."""

    def __init__(self) -> None:
        self.t_ns = 0
        self.wrench = _LoggedInbox[Wrench]()
        self.attitude = _LoggedInbox[Attitude]()
        self.request = OperatorRequest()
        self.status = _KeptOutbox[PlannerStatus]()
        self.ports = PlannerPorts(
            states=(),  # `_receive` passes each with its arrival time
            wrench=self.wrench,
            attitude=self.attitude,
            request=lambda _now_ns: self.request,
            commands=(),  # the status has them
            status=self.status,
            checkpoint=None,
        )


class PlannerExecution:
    """The re-executed planner; each recorded status lists the inputs of its tick."""

    def __init__(
        self,
        robot: RobotConfig,
        outcome: ReexecutionResult,
        controller: Callable[[], Controller] | None = None,
    ) -> None:
        """Prepare to execute a planner with its law or `controller`; `run` fills in `outcome`."""
        self._robot, self.outcome, self._controller = robot, outcome, controller
        self._tick = _Tick()
        self._loop: PlannerLoop | None = None
        self._last: PlannerStatus | None = None

    def run(self, log: RunLog) -> Iterator[tuple[str, Message]]:
        """Execute a run, or its next part, in ticks with complete inputs; yield outputs by key."""
        self._load(log)
        statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
        received = log.received_ns(topics.PLANNER_STATUS)
        for status, received_ns in zip(statuses, received, strict=True):
            if not log.begin_ns <= received_ns < log.end_ns:
                continue
            last, self._last = self._last, status
            if last is not None and not _follows(status, last):
                self._loop = None  # another planner, or ticks that the log lacks
            if self._loop is None or not self._receive(self._loop.planner, status):
                self._loop = None
                self.outcome.skipped += 1
                self._begin(status)
                continue
            yield from self._execute(self._loop, status)

    def _load(self, log: RunLog) -> None:
        self._log_robot = log.robot
        snapshots: list[PlannerCheckpoint] = log.messages(topics.PLANNER_CHECKPOINT)
        self._snapshots = {(snapshot.session, snapshot.t_ns): snapshot for snapshot in snapshots}
        self._states = [BySeq(log.messages(topics.JOINT_STATE, name)) for name in MODULES]
        self._wrenches = BySeq(log.messages(topics.WRENCH))
        self._attitudes = BySeq(log.messages(topics.ATTITUDE))

    def snapshot(self) -> tuple[int, PlannerState] | None:
        """Return the planner's session and present state, or None if it cannot be executed."""
        if self._loop is None:
            return None
        return self._loop.planner.session, copied(self._loop.planner.state)

    def _begin(self, status: PlannerStatus) -> None:
        """Start from the snapshot after this tick, if the log contains one."""
        snapshot = self._snapshots.get((status.session, status.t_ns))
        if snapshot is None:
            return
        known = memory_of(snapshot.snapshot, PlannerState)
        controller = self._controller() if self._controller is not None else None
        planner = Planner(self._robot, status.session, controller)
        planner.state = known
        self._tick = tick = _Tick()
        self._loop = PlannerLoop(self._robot, planner, tick.ports, lambda: tick.t_ns)
        self._taken = (
            [-1 if state is None else state.seq for state in known.states],
            -1 if known.wrench is None else known.wrench.seq,
            -1 if known.attitude is None else known.attitude.seq,
        )
        self.outcome.starts += 1

    def _receive(self, planner: Planner, status: PlannerStatus) -> bool:
        """Pass the inputs of this tick to the planner; return False if the log lacks an input."""
        tick, (state_seq, wrench_seq, attitude_seq) = self._tick, self._taken
        given = True
        for module, (seq, age_ns) in enumerate(
            zip(status.state_seq, status.state_age_ns, strict=True)
        ):
            if seq == state_seq[module]:
                continue
            state = self._states[module].at(seq, status.t_ns - age_ns)
            if state is None:
                given = False
                break
            planner.receive_state(module, state, status.t_ns - age_ns)
        if given and status.wrench_seq != wrench_seq:
            tick.wrench.message = self._wrenches.at(status.wrench_seq, status.t_ns)
            given = tick.wrench.message is not None
        if given and status.attitude_seq != attitude_seq:
            tick.attitude.message = self._attitudes.at(status.attitude_seq, status.t_ns)
            given = tick.attitude.message is not None
        self._taken = list(status.state_seq), status.wrench_seq, status.attitude_seq
        self.outcome.lost_inputs += not given
        tick.t_ns = status.t_ns
        tick.request = OperatorRequest(
            assist_n=status.assist_requested_n,
            shift=status.shift_requested,
            source=status.requested_by,
            sit=status.sit,
            park=status.park_requested,
        )
        return given

    def _execute(self, loop: PlannerLoop, status: PlannerStatus) -> Iterator[tuple[str, Message]]:
        outcome, compare, tick = self.outcome, self.outcome.comparison.take, self._tick
        loop.tick(status.t_ns)
        outcome.ticks += 1
        (computed,) = tick.status.messages
        tick.status.messages.clear()
        # tick_us is a measured time
        recorded = status
        mine = msgspec.structs.replace(computed, tick_us=status.tick_us)
        if len(status.commands) == len(computed.commands) == len(MODULES):
            for name, *commands in zip(MODULES, status.commands, computed.commands, strict=True):
                compare(f"joint/{name}/command", status.seq, *commands)
            recorded, mine = (msgspec.structs.replace(row, commands=()) for row in (status, mine))
        compare("planner/status", status.seq, recorded, mine)
        yield topics.PLANNER_STATUS.key(self._log_robot), computed
        snapshot = self._snapshots.get((status.session, status.t_ns))
        if snapshot is not None and outcome.exact:
            text = _encode(loop.planner.state).decode()
            mine_then = msgspec.structs.replace(snapshot, snapshot=text)
            compare("planner/checkpoint", status.seq, snapshot, mine_then)


def _follows(status: PlannerStatus, last: PlannerStatus) -> bool:
    """Return True for the same planner's next tick; a new session is one above the last."""
    renewed = status.session == last.session + 1 and status.seq == last.seq + 1
    return renewed or (status.session == last.session and status.seq <= last.seq + 1)
