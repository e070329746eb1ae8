"""Reads the files of a run for playback, in the order of the recording."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Final

from shared.clock import NS_PER_S
from shared.exceptions import RunError
from shared.mcap_log.reader import ChunkPlace, LogRecord, open_log
from shared.mcap_log.records import Attachment, Channel, Metadata
from tools.analysis.playback.schedule import Entry
from tools.runs.run_files import MetadataByName, files_in

ROBOT_FILE: Final = "robot.toml"

_OFFSET: Final = re.compile(r"-?[0-9]{1,19}")
_EVER: Final = 1 << 63
_CLOCKS_APART_NS: Final = NS_PER_S
"""Wall clocks are set right by less while a machine runs; a restart changes far more."""


class Recording:
    """Some files of one robot, as one log."""

    def __init__(self, files: Sequence[RecordedFile]) -> None:
        """Take files that belong together, in any order; at least one."""
        self._files = sorted(files, key=lambda file: file.began_ns)
        self.robot = files[0].metadata["run"]["robot"]
        self.robot_file = next((file.robot_file for file in files if file.robot_file), None)
        """The robot file that was in use, as TOML; None if the log does not hold it."""
        self.offset_ns = files[0].offset_ns
        """Wall clock in ns since 1970 = time of an entry + this."""
        self.keys = list(dict.fromkeys(key for file in files for key in file.keys_with_messages()))
        """`Entry.key` counts in these; each has a message."""
        self.unfinished = [file.path for file in files if not file.finished]
        """Files without an end: there may have been more."""
        self.damaged = [file.path for file in files if file.damaged]
        """Files with unreadable places in the middle, as far as is known yet."""
        self.began_ns = min(file.began_ns for file in files)
        """When the first message reached the recorder, by its clock."""
        self.ended_ns = max(file.ended_ns for file in files)
        """When the last one did."""

    def entries(
        self, begin_ns: int = 0, end_ns: int = _EVER, keys: Sequence[str] | None = None
    ) -> list[Entry]:
        """Return messages sorted by time; what came at the same moment stays as in the file.

        Args:
            begin_ns: recorder's clock, inclusive.
            end_ns: the same, exclusive.
            keys: `Entry.key` counts in these, and other messages are left out; None: `self.keys`.
        """
        numbers = {key: number for number, key in enumerate(self.keys if keys is None else keys)}
        found = [row for file in self._files for row in file.entries(begin_ns, end_ns, numbers)]
        found.sort(key=attrgetter("time_ns"))
        return found


def read(paths: Sequence[Path]) -> Recording:
    """Look through files of one run, or of runs of one robot on one clock.

    Args:
        paths: files, in any order.

    Raises:
        RunError: a file is no run, two do not belong together, or none holds a message.
    """
    files: list[RecordedFile] = []
    seen: dict[tuple[str, str], Path] = {}
    for path in paths:
        file = RecordedFile(path)
        split = file.metadata.get("split", {})
        number = (split.get("run", str(path.resolve())), split.get("number", ""))
        if number in seen:
            raise RunError(f"{path}: the same part of the run as {seen[number]}; give one of them")
        seen[number] = path
        if files:
            _check_together(files[0], file)
        files.append(file)
    recording = Recording([file for file in files if file.chunks] or files)
    if not recording.keys:
        raise RunError(f"{', '.join(map(str, paths))}: holds no message; nothing to play")
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


def _check_together(first: RecordedFile, file: RecordedFile) -> None:
    robot, known = (one.metadata["run"]["robot"] for one in (file, first))
    if robot != known:
        raise RunError(
            f"{file.path}: a run of the robot {robot!r}, and those before are of "
            f"{known!r}; play one robot at a time"
        )
    apart_ns = abs(file.offset_ns - first.offset_ns)
    if apart_ns > _CLOCKS_APART_NS:
        raise RunError(
            f"{file.path}: its clock and that of the files before are "
            f"{apart_ns / NS_PER_S:.0f} s apart, so another machine or another day; play one "
            "after the other"
        )


class RecordedFile:
    """One file, looked through; its messages are read when they are needed."""

    def __init__(self, path: Path) -> None:
        """Look through a file.

        Raises:
            RunError: it is no run of this project.
        """
        self.path = path
        self.metadata: MetadataByName = {}
        self.robot_file: str | None = None
        self.chunks: list[ChunkPlace] = []
        self._channels: dict[int, str] = {}
        with open_log(path) as reader:
            for found in reader.skim():
                if isinstance(found, ChunkPlace):
                    self.chunks.append(found)
                else:
                    self._learn(found)
            self.finished = reader.finished
            self.damaged = bool(reader.damage)
        self.offset_ns = self._check()
        times = [(chunk.first_ns, chunk.last_ns) for chunk in self.chunks] or [
            (self.offset_ns,) * 2
        ]
        self.began_ns = min(first for first, _ in times) - self.offset_ns
        self.ended_ns = max(last for _, last in times) - self.offset_ns

    def keys_with_messages(self) -> list[str]:
        """Return the keys that have a message, in the order of their channels."""
        known = {n for chunk in self.chunks if chunk.channels is not None for n in chunk.channels}
        if any(chunk.channels is None for chunk in self.chunks):
            known |= {row.channel_id for record in self._records(0, _EVER) for row in record.rows}
        return [self._channels[number] for number in sorted(known) if number in self._channels]

    def entries(self, begin_ns: int, end_ns: int, numbers: dict[str, int]) -> Iterator[Entry]:
        """Yield messages from a time to another, of the keys that have a number."""
        offset_ns = self.offset_ns
        begin_ns, end_ns = begin_ns + offset_ns, end_ns + offset_ns
        for record in self._records(begin_ns, end_ns):
            body = record.body
            wanted = {n: numbers.get(key, -1) for n, key in self._channels.items()}
            for channel, _, log_ns, _, start, end in record.rows:
                number = wanted.get(channel, -1)
                if number >= 0 and begin_ns <= log_ns < end_ns:
                    yield Entry(log_ns - offset_ns, number, body[start:end])

    def _records(self, begin_ns: int, end_ns: int) -> Iterator[LogRecord]:
        with open_log(self.path) as reader:
            for place in self.chunks:
                if place.last_ns >= begin_ns and place.first_ns < end_ns:
                    try:
                        record = reader.read_at(place.start)
                    except RunError as error:
                        raise RunError(f"{self.path}: {error}") from None
                    if record is not None:
                        self._learn(record)
                        yield record
            self.damaged = self.damaged or bool(reader.damage)

    def _learn(self, record: LogRecord) -> None:
        for value in record.values():
            match value:
                case Channel(id=number, topic=topic):
                    self._channels[number] = topic
                case Metadata(name=name, metadata=entries):
                    self.metadata[name] = entries
                case Attachment(name=name, data=data) if name == ROBOT_FILE:
                    self.robot_file = data.decode(errors="replace")

    def _check(self) -> int:
        """Return the clock's offset of a run of this project.

        Raises:
            RunError: it is none.
        """
        robot = self.metadata.get("run", {}).get("robot", "")
        offset = self.metadata.get("clock", {}).get("offset_ns", "")
        if not robot or not _OFFSET.fullmatch(offset):
            raise RunError(
                f"{self.path}: no metadata run.robot and clock.offset_ns; an MCAP file written by "
                "services.recorder, not cut off before its first message, is right"
            )
        return int(offset)
