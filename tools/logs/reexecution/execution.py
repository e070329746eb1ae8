"""Executes a service of a run again, whichever it is; also in ranges of time side by side.

Each range begins a little before its begin, at the memory that the services recorded there, and
what comes before its begin is not counted. So every tick is executed once, from a memory that the
range before it is held to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from services.planner.controller import Controller
from shared.config.robot_config import RobotConfig
from tools.logs.reexecution.compare import ReexecutionResult
from tools.logs.reexecution.joint import JointExecution
from tools.logs.reexecution.planner import PlannerExecution
from tools.logs.run_index import RunIndex
from tools.logs.run_log import MARGIN_S, NOTHING, RunLog, RunPart, divided, parts_of, robot_of

Execution: TypeAlias = JointExecution | PlannerExecution


def execution_of(
    robot: RobotConfig,
    name: str,
    tolerance: float = 0.0,
    *,
    exact: bool = True,
    controller: Callable[[], Controller] | None = None,
) -> Execution:
    """Return what executes a service with a robot; a planner perhaps with another controller."""
    outcome = ReexecutionResult(name, tolerance, exact=exact)
    if name == "planner":
        return PlannerExecution(robot, outcome, controller)
    return JointExecution(robot, name, outcome)


RANGE_S: Final = 60.0
"""Length of a range; shorter ones spend more on their lead-in and on starting."""
LEAD_S: Final = 2.5
"""Lead-in: memories are a second apart."""


class RangeTask(NamedTuple):
    """One range of a run."""

    run: Path
    part: RunPart
    services: tuple[str, ...]
    tolerance: float


def ranges_of(
    index: RunIndex,
    part: RunPart,
    services: tuple[str, ...],
    tolerance: float,
    workers: int,
    *,
    range_s: float = RANGE_S,
) -> list[RangeTask]:
    """Return a part of a run in ranges, in their order."""
    pieces = divided(index, part, range_s, workers)
    return [RangeTask(index.path, piece, services, tolerance) for piece in pieces]


def execute_range(task: RangeTask) -> list[ReexecutionResult]:
    """Execute one range; return a result for each service, in the order of their names."""
    index = _index_of(task.run)
    robot = robot_of(RunLog(index, NOTHING, as_sent=True))
    executions = [execution_of(robot, name, task.tolerance) for name in task.services]
    begin_s = task.part.begin_s
    if begin_s > 0.0:
        before = RunPart(max(0.0, begin_s - LEAD_S), begin_s)
        _execute(executions, RunLog(index, before, MARGIN_S, as_sent=True))
        for execution in executions:
            execution.outcome.forget()
    for log in parts_of(index, task.part, as_sent=True):
        _execute(executions, log)
    return [execution.outcome for execution in executions]


def merged(results: Sequence[list[ReexecutionResult]]) -> list[ReexecutionResult]:
    """Return one result for each service, from those of the ranges in their order."""
    whole = results[0]
    for later in results[1:]:
        for mine, its in zip(whole, later, strict=True):
            mine.add(its)
    return whole


@lru_cache(maxsize=1)
def _index_of(run: Path) -> RunIndex:
    return RunIndex(run)


def _execute(executions: Sequence[Execution], log: RunLog) -> None:
    for execution in executions:
        for _ in execution.run(log):
            pass
