"""One service of a run, whichever it is, executed again."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from services.planner.controller import Controller
from shared.bus import topics
from shared.bus.messages import JointEvent, JointState, Message, PlannerStatus
from shared.config.robot_config import RobotConfig
from tools.logs.reexecution.joint import JointExecution
from tools.logs.reexecution.outcome import ReexecutionResult
from tools.logs.reexecution.planner import PlannerExecution
from tools.logs.run_log import RunLog


class Execution:
    """One service, executed again from a run or from its parts one after the other."""

    def __init__(
        self,
        robot: RobotConfig,
        name: str,
        tolerance: float = 0.0,
        *,
        exact: bool = True,
        controller: Callable[[], Controller] | None = None,
    ) -> None:
        """Take the robot to execute with, the service, how to compare, and a controller."""
        self.outcome = ReexecutionResult(name, tolerance, exact=exact)
        self._planner = (
            PlannerExecution(robot, self.outcome, controller) if name == "planner" else None
        )
        self._joint = None if name == "planner" else JointExecution(robot, name, self.outcome)

    @property
    def differs(self) -> bool:
        """True once something came out otherwise than recorded."""
        return self.outcome.comparison.first is not None

    def run(self, log: RunLog) -> Iterator[tuple[str, Message]]:
        """Execute a part; yield what comes out, with its full key."""
        if self._planner is not None:
            for module, message in self._planner.run(log):
                status = isinstance(message, PlannerStatus)
                topic = topics.PLANNER_STATUS if status else topics.JOINT_COMMAND
                yield topic.key(log.robot, module), message
        if self._joint is not None:
            for message in self._joint.run(log):
                if isinstance(message, JointState):
                    yield topics.JOINT_STATE.key(log.robot, self.outcome.service), message
                elif isinstance(message, JointEvent):
                    yield topics.JOINT_EVENT.key(log.robot, self.outcome.service), message
