"""Reads the files of a run for playback, in the order of the recording."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Final

import msgspec

from shared.clock import NS_PER_S
from shared.exceptions import RunError
from shared.mcap_log.reader import LogReader, LogRecord, open_log
from shared.mcap_log.records import Attachment, Channel, Metadata
from tools.analysis.playback.schedule import Entry
from tools.runs.run_files import MetadataByName, files_in

ROBOT_FILE: Final = "robot.toml"

_CLOCKS_APART_NS: Final = NS_PER_S
"""Wall clocks are set right by less while a machine runs; a restart changes far more."""


class Recording(msgspec.Struct):
    """Some files of one robot, as one log."""

    robot: str = ""
    robot_file: str | None = None
    """The robot file that was in use, as TOML; None if the log does not hold it."""
    offset_ns: int = 0
    """Wall clock in ns since 1970 = time of an entry + this."""
    keys: list[str] = msgspec.field(default_factory=list)
    """`Entry.key` counts in these; each has a message."""
    entries: list[Entry] = msgspec.field(default_factory=list)
    """Sorted by time; what came at the same moment stays as it stood in the file."""
    unfinished: list[Path] = msgspec.field(default_factory=list)
    """Files without an end: there may have been more."""
    damaged: list[Path] = msgspec.field(default_factory=list)
    """Files with unreadable places in the middle."""

    @property
    def began_ns(self) -> int:
        """When the first message reached the recorder, by its clock."""
        return self.entries[0].time_ns

    @property
    def ended_ns(self) -> int:
        """When the last one did."""
        return self.entries[-1].time_ns


def read(paths: Sequence[Path]) -> Recording:
    """Read files of one run, or of runs of one robot on one clock.

    Args:
        paths: files, in any order.

    Raises:
        RunError: a file is no run, two do not belong together, or none holds a message.
    """
    recording = Recording()
    index: dict[str, int] = {}
    seen: dict[tuple[str, str], Path] = {}
    for path in paths:
        file = _File(path, index)
        file.check()
        split = file.metadata.get("split", {})
        number = (split.get("run", str(path.resolve())), split.get("number", ""))
        if number in seen:
            raise RunError(f"{path}: the same part of the run as {seen[number]}; give one of them")
        seen[number] = path
        _join(recording, file)
    if not recording.entries:
        raise RunError(f"{', '.join(map(str, paths))}: holds no message; nothing to play")
    recording.keys = list(index)
    recording.entries.sort(key=attrgetter("time_ns"))
    return recording


def files_named(given: Iterable[Path]) -> list[Path]:
    """Return the files meant: for a directory those of the run in it.

    Raises:
        RunError: a directory holds no run, or several.
    """
    found: list[Path] = []
    for path in given:
        found += files_in(path) if path.is_dir() else [path]
    if not found:
        raise RunError("no FILE; write it first: xrl play FILE --topics 'joint/*/state'")
    return found


def _join(recording: Recording, file: _File) -> None:
    robot = file.metadata["run"]["robot"]
    if not recording.robot:
        recording.robot, recording.offset_ns = robot, file.offset_ns
    if robot != recording.robot:
        raise RunError(
            f"{file.path}: a run of the robot {robot!r}, and those before are of "
            f"{recording.robot!r}; play one robot at a time"
        )
    apart_ns = abs(file.offset_ns - recording.offset_ns)
    if apart_ns > _CLOCKS_APART_NS:
        raise RunError(
            f"{file.path}: its clock and that of the files before are "
            f"{apart_ns / NS_PER_S:.0f} s apart, so another machine or another day; play one "
            "after the other"
        )
    recording.robot_file = recording.robot_file or file.robot_file
    recording.entries += file.entries
    if not file.finished:
        recording.unfinished.append(file.path)
    if file.damaged:
        recording.damaged.append(file.path)


class _File:
    """One file, read through."""

    def __init__(self, path: Path, index: dict[str, int]) -> None:
        self.path = path
        self.metadata: MetadataByName = {}
        self.robot_file: str | None = None
        self.entries: list[Entry] = []
        self.offset_ns = 0
        self._index = index
        self._channels: dict[int, str] = {}
        with open_log(path) as reader:
            self._read(reader)
            self.finished = reader.finished
            self.damaged = bool(reader.damage)

    def check(self) -> None:
        """Refuse a file that is no run of this project.

        Raises:
            RunError: it is none.
        """
        robot = self.metadata.get("run", {}).get("robot", "")
        offset = self.metadata.get("clock", {}).get("offset_ns", "")
        try:
            offset_ns = int(offset)
        except ValueError:
            robot = ""
        if not robot:
            raise RunError(
                f"{self.path}: no metadata run.robot and clock.offset_ns; an MCAP file written by "
                "services.recorder, not cut off before its first message, is right"
            )
        self.offset_ns = offset_ns
        self.entries = [row._replace(time_ns=row.time_ns - offset_ns) for row in self.entries]

    def _read(self, reader: LogReader) -> None:
        for record in reader:
            for value in record.values():
                match value:
                    case Channel(id=number, topic=topic):
                        self._channels[number] = topic
                    case Metadata(name=name, metadata=entries):
                        self.metadata[name] = entries
                    case Attachment(name=name, data=data) if name == ROBOT_FILE:
                        self.robot_file = data.decode(errors="replace")
            self._take_messages(record)

    def _take_messages(self, record: LogRecord) -> None:
        body, index = record.body, self._index
        for channel, _, log_ns, _, start, end in record.rows:
            topic = self._channels.get(channel)
            if topic is not None:
                key = index.setdefault(topic, len(index))
                self.entries.append(Entry(log_ns, key, body[start:end]))
