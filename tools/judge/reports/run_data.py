"""Log of a run as arrays over one time axis."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import DriveStatus
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import XrlError
from shared.joints import MODULES
from tools.judge import verdict
from tools.judge.reports.signals import Span, message_times
from tools.judge.verdict import Course
from tools.logs.run_log import RunLog, robot_of


class TimeAxis(NamedTuple):
    """The time axis of a page."""

    zero_ns: int
    """Monotonic stamp of time 0."""
    span: Span
    """What the page shows: a run, or the part asked for."""


class RunData:
    """A log or a part of one, its time axis and its robot."""

    def __init__(
        self, log: RunLog, axis: TimeAxis | None = None, armed_before_s: float | None = None
    ) -> None:
        self.armed_before_s = armed_before_s
        self.log = log
        self.course: Course | None = None
        """Trajectory of the simulated world; None if the log has none or its scenario never
        began."""
        self.without_course = ""
        """Reason why `course` is None."""
        try:
            self.course = verdict.course(log)
        except XrlError as error:
            self.without_course = _reason(log, error)
        self.robot: RobotConfig | None = None
        """Configuration of the robot; None if the log holds none that this version can read."""
        self.without_robot = ""
        """Reason why `robot` is None."""
        try:
            self.robot = robot_of(log)
        except XrlError as error:
            self.without_robot = _reason(log, error)
        if axis is None:
            zero_ns = self.course.zero_ns if self.course else log.began_ns()
            axis = TimeAxis(zero_ns, Span(_s(log.begin_ns - zero_ns), _s(log.end_ns - 1 - zero_ns)))
        self.zero_ns, self.span = axis
        self.begin_s = -np.inf if log.is_first else self.at(log.begin_ns)
        self.end_s = np.inf if log.is_last else self.at(log.end_ns)
        """Time to take from this log: what lies outside is a margin."""
        self._times: dict[tuple[str, str], Array] = {}

    def at(self, t_ns: int) -> float:
        """Return a monotonic stamp as time on the axis, s."""
        return _s(t_ns - self.zero_ns)

    def inside(self, t: Array | float) -> NDArray[np.bool_]:
        """Return True for times on the axis that are not in a margin."""
        return np.asarray((t >= self.begin_s) & (t < self.end_s))

    @property
    def axis(self) -> str:
        """Description of the time axis."""
        if self.course is None:
            return "time since the log begins, s"
        if self.course.began:
            return "scenario time, s"
        return "time since the hoist released the robot, s"

    def times(self, topic: Topic, module: str = "") -> Array:
        """Return the time of each message, s.

        A joint service that has no sample from its drive yet publishes a stamp of 0. A message
        with a stamp from before the log is placed at its time of reception.
        """
        found = self._times.get((topic.name, module))
        if found is None:
            messages: list[Any] = self.log.messages(topic, module)
            received = self.log.received_ns(topic, module)
            earliest_ns = self.log.began_ns() - NS_PER_S // 5
            stamps = [
                message.t_ns if message.t_ns >= earliest_ns else received_ns
                for message, received_ns in zip(messages, received, strict=True)
            ]
            found = message_times(stamps, self.zero_ns, received)
            self._times[topic.name, module] = found
        return found

    def columns(self, topic: Topic, module: str, *names: str) -> list[Array]:
        """Return one array for each field: (n,), or (n, k) for a field of k numbers."""
        messages: list[Any] = self.log.messages(topic, module)
        return [
            np.array([getattr(message, name) for message in messages], dtype=np.float64)
            for name in names
        ]

    def wide(self, topic: Topic, name: str, width: int, module: str = "") -> Array:
        """Return a field of some numbers (n, width), even without messages."""
        (values,) = self.columns(topic, module, name)
        return values.reshape(-1, width)

    def armed_s(self) -> float:
        """Return when all six drives were armed for the first time, s; if never, the begin.

        Earlier figures describe a robot that does not stand yet. A part of a run before that has
        no time from which they count: it is infinite.
        """
        if self.armed_before_s is not None:
            return self.armed_before_s
        found = []
        for module in MODULES:
            (drive,) = self.columns(topics.JOINT_STATE, module, "drive")
            armed = np.flatnonzero(drive == DriveStatus.ARMED)
            if not len(armed):
                return self.span.begin if self.log.is_whole else math.inf
            found.append(float(self.times(topics.JOINT_STATE, module)[armed[0]]))
        return max(found)


def module_of(topic: Topic, key: str) -> str:
    """Return the module of a full key; empty if its topic has no modules."""
    return key.split("/")[-2] if topic.per_module else ""


def _reason(log: RunLog, error: XrlError) -> str:
    """Return an error's text without the path of the file, since pages are shared."""
    return str(error).replace(f"{log.path}: ", "").replace(str(log.path), log.path.name)


def _s(ns: int) -> float:
    return ns / NS_PER_S
