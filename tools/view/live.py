"""Frames of a live fleet; subscribed only while somebody looks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from shared.bus import topics
from shared.bus.session import Latest, Session, open_session
from shared.bus.topics import Topic
from shared.clock import now_ns
from shared.config.robot_config import RobotConfig
from shared.robot.joints import MODULES
from tools.view.frame import Frame, Newest
from tools.view.source import Source


class LiveSource(Source):
    """The fleet whose sockets are in a run directory, or at the robot file's hosts."""

    kind = "live"

    def __init__(self, robot: RobotConfig, run_dir: Path) -> None:
        super().__init__(robot)
        self.title = f"live, {run_dir}"
        self._run_dir = run_dir
        self._session: Session | None = None
        self._latest: list[tuple[Topic, str, Latest[Any]]] = []
        self._newest = Newest(robot)

    def connect(self) -> None:
        """Subscribe.

        Raises:
            BusError: the bus cannot be opened.
        """
        if self._session is not None:
            return
        session = self._session = open_session(self.robot, "view", self._run_dir)
        self._newest = Newest(self.robot)
        wanted = [(topic, "") for topic in (topics.PLANNER_STATUS, topics.WRENCH, topics.SIM_TRUTH)]
        wanted += [(t, m) for t in (topics.JOINT_STATE, topics.JOINT_COMMAND) for m in MODULES]
        self._latest = [(t, m, session.latest(t, t.type, m)) for t, m in wanted]

    def disconnect(self) -> None:
        """Leave the bus."""
        session, self._session, self._latest = self._session, None, []
        if session is not None:
            session.close()

    def frame(self, t_s: float) -> Frame | None:  # noqa: ARG002 - a live fleet has no other time
        """Return the newest frame."""
        for topic, module, latest in self._latest:
            message = latest.take()
            if message is not None:
                self._newest.take(topic, module, message)
        return self._newest.frame(now_ns())
