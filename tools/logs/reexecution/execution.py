"""Re-execution of a run's services, in ranges of time that can be executed in parallel.

Execution of each range begins slightly early, at a recorded snapshot of the services. The part
before the range is not counted. So every tick counts once. The snapshot from which a range starts
is also compared with the result of the previous range.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple, TypeAlias

from services.planner.controller import Controller, controller_maker
from shared.config.robot_config import RobotConfig
from tools.logs.reexecution.compare import ReexecutionResult
from tools.logs.reexecution.joint import JointExecution
from tools.logs.reexecution.params import with_params
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
    """Return the executor of a service; `controller` replaces the planner's law."""
    outcome = ReexecutionResult(name, tolerance, exact=exact)
    if name == "planner":
        return PlannerExecution(robot, outcome, controller)
    return JointExecution(robot, name, outcome)


RANGE_S: Final = 60.0
"""Length of a range, s; shorter ranges spend more time on their lead-in and on starting."""
LEAD_S: Final = 2.5
"""Lead-in before a range, s; snapshots are a second apart."""


class RangeTask(NamedTuple):
    """One range of a run, and how to execute it."""

    run: Path
    part: RunPart
    services: tuple[str, ...]
    tolerance: float = 0.0
    params: tuple[str, ...] = ()
    """Changed keys of the robot file (`with_params`)."""
    controller: str = ""
    """The user's own controller instead of the law, as for `--controller`."""

    @property
    def is_changed(self) -> bool:
        """True if the execution differs from the recorded run."""
        return bool(self.params or self.controller)


def ranges_of(
    index: RunIndex, whole: RangeTask, workers: int, range_s: float = RANGE_S
) -> list[RangeTask]:
    """Divide a task into ranges, in order.

    The effects of a changed parameter or controller carry over, so such a task is not divided.
    """
    if whole.is_changed:
        return [whole]
    pieces = divided(index, whole.part, range_s, workers)
    return [whole._replace(part=piece) for piece in pieces]


def execute_range(task: RangeTask) -> list[ReexecutionResult]:
    """Execute one range; return a result for each service, in the order of the task."""
    index = _index_of(task.run)
    recorded = robot_of(RunLog(index, NOTHING, as_sent=True))
    robot = with_params(recorded, task.params, str(task.run)) if task.params else recorded
    make = controller_maker(task.controller, robot) if task.controller else None
    exact = not task.is_changed
    executions = [
        execution_of(robot, name, task.tolerance, exact=exact, controller=make)
        for name in task.services
    ]
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
    """Return one result per service, from those of the ranges in order."""
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
