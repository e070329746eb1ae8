"""Frames of a record: any moment of it, in any order."""

from __future__ import annotations

import bisect
from typing import Any

import msgspec

from shared.bus import topics
from shared.bus.messages import Message, RunEventKind
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.judge.reports.run_data import RunData
from tools.judge.reports.timeline import timeline_events
from tools.logs.run_log import RunLog
from tools.view.frame import SHOWN, SHOWN_OF_MODULES, Frame, Newest
from tools.view.source import Mark, Model, Source


class _Key:
    """The messages of one key, found by time."""

    def __init__(self, topic: Topic, module: str, rows: list[Any]) -> None:
        self.topic, self.module = topic, module
        self._rows = rows
        self._stamps = [row.t_ns for row in rows]

    def at(self, t_ns: int) -> Message | None:
        index = bisect.bisect_right(self._stamps, t_ns) - 1
        return self._rows[index] if index >= 0 else None


class RecordSource(Source):
    """A run's record, or a part of it."""

    kind = "record"

    def __init__(self, log: RunLog, robot: RobotConfig) -> None:
        super().__init__(robot)
        self.title = str(log.path)
        self._data = RunData(log)
        self._newest = Newest(robot)
        wanted = [(topic, "") for topic in SHOWN if topic is not topics.RUN_EVENT]
        wanted += [(topic, module) for topic in SHOWN_OF_MODULES for module in MODULES]
        self._keys = [_Key(topic, m, log.messages(topic, m)) for topic, m in wanted]
        stalls = [row for row in log.messages(topics.RUN_EVENT) if row.kind == RunEventKind.STALLED]
        stalls.sort(key=lambda row: row.t_ns)  # each tells when it ended, and is told later
        self._keys.append(_Key(topics.RUN_EVENT, "", stalls))
        self._marks = tuple(
            Mark(event.t, event.kind, event.text) for event in timeline_events(self._data)
        )

    def model(self) -> Model:
        """Return what does not change, with the record's timeline."""
        span = self._data.span
        return msgspec.structs.replace(
            super().model(), begin_s=span.begin, end_s=span.end, marks=self._marks
        )

    def frame(self, t_s: float) -> Frame | None:
        """Return the frame at a time of the timeline; None before each module was heard."""
        t_ns = self._data.zero_ns + round(t_s * NS_PER_S)
        newest = self._newest
        newest.clear()
        for key in self._keys:
            message = key.at(t_ns)
            if message is not None:
                newest.take(key.topic, key.module, message)
        found = newest.frame(t_ns)
        return None if found is None else msgspec.structs.replace(found, t_s=t_s)
