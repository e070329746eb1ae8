"""Executing a service of a log again, to its end."""

from __future__ import annotations

from collections.abc import Iterable

from shared.config.robot_config import RobotConfig
from tools.logs.reexecution.compare import ReexecutionResult
from tools.logs.reexecution.execution import execution_of
from tools.logs.run_log import RunLog, robot_of


def executed(
    log: RunLog,
    name: str,
    tolerance: float = 0.0,
    *,
    parts: Iterable[RunLog] = (),
    robot: RobotConfig | None = None,
    exact: bool = True,
) -> ReexecutionResult:
    """Execute a service; from a log, or from its parts one after the other."""
    execution = execution_of(robot or robot_of(log), name, tolerance, exact=exact)
    for part in parts or (log,):
        for _ in execution.run(part):
            pass
    return execution.outcome
