"""Log of a run as arrays on one time axis."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.arrays import Array
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.exceptions import XrlError
from tools.judge import verdict
from tools.judge.verdict import Course
from tools.logs.run_log import RunLog, robot_of


class Span(NamedTuple):
    """Time range that a page shows, s."""

    begin: float
    end: float


class RunData:
    """A log or a part of it, its time axis and its robot."""

    def __init__(self, log: RunLog, zero_ns: int | None = None, span: Span | None = None) -> None:
        self.log = log
        self.course: Course | None = None
        """Trajectory of the simulated world; None if the log lacks it, or if the scenario never
        started and the robot did not fall."""
        self.without_course = ""
        """Reason why `course` is None."""
        try:
            self.course = verdict.course(log)
        except XrlError as error:  # without the file's path, because pages are shared
            self.without_course = str(error).replace(f"{log.path}: ", "")
        self.robot: RobotConfig | None = None
        """Configuration of the robot; None if this version cannot read one from the log."""
        with contextlib.suppress(XrlError):
            self.robot = robot_of(log)
        if zero_ns is None:
            zero_ns = self.course.zero_ns if self.course else log.began_ns()
        self.zero_ns = zero_ns
        """Monotonic stamp of time 0."""
        self.span = span or Span(self.at(log.begin_ns), self.at(log.end_ns - 1))
        self._begin_s = -np.inf if log.is_first else self.at(log.begin_ns)
        self._end_s = np.inf if log.is_last else self.at(log.end_ns)
        self._times: dict[tuple[str, str], Array] = {}

    def at(self, t_ns: int) -> float:
        """Return a monotonic stamp as time on the axis, s."""
        return (t_ns - self.zero_ns) / NS_PER_S

    def on_axis(self, stamps_ns: Sequence[int] | NDArray[np.int64]) -> Array:
        """Return monotonic stamps as times on the axis, s."""
        return (np.asarray(stamps_ns, dtype=np.int64) - self.zero_ns) / NS_PER_S

    def inside(self, t: Array | float) -> NDArray[np.bool_]:
        """Return True for times of this part, False for its margins."""
        return np.asarray((t >= self._begin_s) & (t < self._end_s))

    @property
    def axis(self) -> str:
        """Description of the time axis."""
        if self.course is None:
            return "time since the log begins, s"
        if self.course.began:
            return "scenario time, s"
        return "time since the hoist released the robot, s"

    def times(self, topic: Topic, module: str = "") -> Array:
        """Return the time of each message, s; the times never decrease.

        A message is placed at its reception if its stamp is from before the log, or not newer than
        the stamp before it: a joint service repeats the stamp of its drive's last sample, or
        publishes a stamp of 0.
        """
        found = self._times.get((topic.name, module))
        if found is None:
            messages: list[Any] = self.log.messages(topic, module)
            stamps = np.array([message.t_ns for message in messages], dtype=np.int64)
            received = np.array(self.log.received_ns(topic, module), dtype=np.int64)
            is_old = np.diff(stamps, prepend=0) <= 0
            is_old |= stamps < self.log.began_ns() - NS_PER_S // 5
            stamps = np.maximum.accumulate(np.where(is_old, received, stamps))
            found = self._times[topic.name, module] = self.on_axis(stamps)
        return found

    def columns(self, topic: Topic, module: str, *names: str) -> list[Array]:
        """Return one array for each field: (n,), or (n, k) for a field of k numbers."""
        messages: list[Any] = self.log.messages(topic, module)
        return [
            np.array([getattr(message, name) for message in messages], dtype=np.float64)
            for name in names
        ]

    def wide(self, topic: Topic, name: str, width: int, module: str = "") -> Array:
        """Return a field of several numbers (n, width), even without messages."""
        (values,) = self.columns(topic, module, name)
        return values.reshape(-1, width)
