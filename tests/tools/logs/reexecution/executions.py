"""Executing a service of a log again, to its end; logs with changed messages."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from typing import Any

from shared.bus.topics import Topic
from shared.config.robot_config import RobotConfig
from tools.logs.reexecution.compare import ReexecutionResult
from tools.logs.reexecution.execution import execution_of
from tools.logs.run_log import RunLog, Series, robot_of


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


def edited(log: RunLog, topic: Topic, module: str, change: Callable[[Any], Any]) -> RunLog:
    """Return a copy of a log with messages of one key changed, or left out where that is None."""
    messages, received = log.messages(topic, module), log.received_ns(topic, module)
    rows = zip(map(change, messages), received, strict=True)
    kept = [(message, at_ns) for message, at_ns in rows if message is not None]
    series = Series()
    series.decoded, series.received_ns = [row[0] for row in kept], [row[1] for row in kept]
    copied = copy.copy(log)
    copied._series = log._series | {topic.key(log.robot, module): series}
    return copied
