"""Moments of a recorded run from which a different run can continue."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final, TypeVar

import msgspec

from services.joint.drive_manager import DriveManagerState
from services.planner.planner import PlannerState
from shared.bus import topics
from shared.bus.messages import PlannerStatus
from shared.bus.traces import SimState
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import MODULES
from tools.logs.reexecution.joint import JointExecution
from tools.logs.reexecution.outcome import ReexecutionResult
from tools.logs.reexecution.planner import PlannerExecution
from tools.logs.run_log import RunLog

R = TypeVar("R")
T = TypeVar("T")

EARLY_S: Final = 0.5 / topics.SIM_STATE.rate_hz
"""A state so long before a moment is the nearest one."""
NEAR_NS: Final = 12 * NS_PER_MS
"""A service whose last cycle lies further before a moment counts as dead in it."""


class Moment(msgspec.Struct):
    """All that a fleet is at one time of a run."""

    state: SimState
    modules: dict[str, DriveManagerState] = msgspec.field(default_factory=dict)
    """What each joint service that was alive knew."""
    planner: tuple[int, PlannerState] | None = None
    """Session and state of the planner, if it was alive."""
    margin: float | None = None
    """Margin of the failsafe certificate, as last published."""

    @property
    def at_s(self) -> float:
        """Scenario time."""
        return self.state.scenario_s

    def runs(self, services: Sequence[str]) -> bool:
        """Return True if at least one of some services (planner, modules) runs at this moment."""
        return any(
            self.planner is not None if name == "planner" else name in self.modules
            for name in services
        )


def moments_of(log: RunLog, robot: RobotConfig, every_s: float) -> list[Moment]:
    """Return the moments of a run's scenario, so far apart.

    Joint services and planner are executed again from the log up to each moment, and so are
    where they were to the last bit.

    Raises:
        RunError: the run holds no states of the simulated world.
    """
    states: list[SimState] = log.messages(topics.SIM_STATE)
    found = []
    due_s = 0.0
    for state in states:
        if state.scenario_s >= max(0.0, due_s - EARLY_S):
            found.append(Moment(state))
            due_s = every_s * (1 + math.floor((state.scenario_s + EARLY_S) / every_s))
    if not found:
        raise RunError(
            f"{log.path}: no state of the simulated world in it (sim/state); a run of this version "
            "whose scenario has begun has one every 0.1 s, a real robot's has none"
        )
    for name in MODULES:
        joint = JointExecution(robot, name, ReexecutionResult(name, 0.0, exact=False))
        rows = ((message.t_ns, joint) for message in joint.run(log))
        for moment, snapshot in _at(found, rows, _copy):
            if snapshot is not None:
                moment.modules[name] = snapshot
    planner = PlannerExecution(robot, ReexecutionResult("planner", 0.0, exact=False))
    ticks = ((m.t_ns, planner) for _, m in planner.run(log) if isinstance(m, PlannerStatus))
    for moment, known in _at(found, ticks, PlannerExecution.snapshot):
        moment.planner = known
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    published = ((status.t_ns, status) for status in statuses)
    for moment, margin in _at(found, published, lambda status: status.margin):
        moment.margin = margin
    return found


def _copy(execution: JointExecution) -> DriveManagerState | None:
    """Return a copy of a service's present state: its own keeps changing."""
    snapshot = execution.snapshot()
    if snapshot is None:
        return None
    return msgspec.json.decode(msgspec.json.encode(snapshot), type=DriveManagerState)


def _at(
    moments: Sequence[Moment], rows: Iterable[tuple[int, R]], kept: Callable[[R], T]
) -> Iterator[tuple[Moment, T]]:
    """Yield moments with what `kept` takes of the last row before each, if it is near.

    Rows come with their times, in order; a row is valid only until the next one.
    """
    index = 0
    last: list[T] = []
    for t_ns, row in rows:
        while index < len(moments) and t_ns > moments[index].state.t_ns:
            yield from ((moments[index], value) for value in last)
            last = []
            index += 1
        if index == len(moments):
            return
        if moments[index].state.t_ns - t_ns <= NEAR_NS:
            last = [kept(row)]
    if index < len(moments):
        yield from ((moments[index], value) for value in last)
