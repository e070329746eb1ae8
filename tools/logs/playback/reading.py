"""Reads the files of a run for playback, in the order of the recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Final

from shared.clock import NS_PER_S
from shared.exceptions import RunError
from tools.logs.playback.schedule import Entry
from tools.logs.run_index import RecordedFile, files_in

ROBOT_FILE: Final = "robot.toml"

_EVER: Final = 1 << 63
_CLOCKS_APART_NS: Final = NS_PER_S
"""Wall clocks are set right by less while a machine runs; a restart changes far more."""


class Recording:
    """Some files of one robot, as one log."""

    def __init__(self, files: Sequence[RecordedFile]) -> None:
        self._files = sorted(files, key=lambda file: file.span_ns or (0, 0))
        self.robot = files[0].required("run", "robot")
        text = next(
            (file.attachments[ROBOT_FILE] for file in files if ROBOT_FILE in file.attachments), None
        )
        self.robot_file = None if text is None else text.decode("utf-8-sig", errors="replace")
        """The robot file that was in use, as TOML; None if the log does not hold it."""
        self.offset_ns = files[0].offset_ns
        """Wall clock in ns since 1970 = time of an entry + this."""
        self.keys = list(dict.fromkeys(key for file in files for key in file.keys_with_messages()))
        """`Entry.key` counts in these; each has a message."""
        self.unfinished = [file.path for file in files if not file.finished]
        """Files without an end: there may have been more."""
        self.damaged = [file.path for file in files if file.damage]
        """Files with unreadable places in the middle, as far as is known yet."""
        spans = [(*file.span_ns, file.offset_ns) for file in files if file.span_ns is not None]
        self.began_ns = min((begin - offset for begin, _, offset in spans), default=0)
        """When the first message reached the recorder, by its clock."""
        self.ended_ns = max((end - offset for _, end, offset in spans), default=0)
        """When the last one did."""

    def entries(
        self, begin_ns: int = 0, end_ns: int = _EVER, keys: Sequence[str] | None = None
    ) -> list[Entry]:
        """Return messages sorted by time; what came at the same moment stays as in the file.

        Times are of the recorder's clock, the first inclusive. `Entry.key` counts in `keys`; if
        that is None, in `self.keys`.
        """
        numbers = {key: number for number, key in enumerate(self.keys if keys is None else keys)}
        found = [row for file in self._files for row in _entries(file, begin_ns, end_ns, numbers)]
        found.sort(key=attrgetter("time_ns"))
        return found


def _entries(
    file: RecordedFile, begin_ns: int, end_ns: int, numbers: Mapping[str, int]
) -> Iterator[Entry]:
    offset_ns = file.offset_ns
    begin_ns, end_ns = begin_ns + offset_ns, end_ns + offset_ns
    for record in file.records(begin_ns, end_ns, frozenset(numbers)):
        body = record.body
        wanted = {channel: numbers.get(key, -1) for channel, key in file.keys.items()}
        for channel, _, log_ns, _, start, end in record.rows:
            number = wanted.get(channel, -1)
            if number >= 0 and begin_ns <= log_ns < end_ns:
                yield Entry(log_ns - offset_ns, number, body[start:end])


def read(paths: Sequence[Path]) -> Recording:
    """Look through files of one run, or of runs of one robot on one clock."""
    files: list[RecordedFile] = []
    seen: dict[tuple[str, str], Path] = {}
    for path in paths:
        file = RecordedFile(path)
        file.required("run", "robot")
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
    """Return the files meant: for a directory those of the run in it."""
    found: list[Path] = []
    for path in given:
        found += files_in(path) if path.is_dir() else [path]
    if not found:
        raise RunError("no FILE; write it first: xrl log play FILE --topics 'joint/*/state'")
    return found


def _check_together(first: RecordedFile, file: RecordedFile) -> None:
    robot, known = (one.required("run", "robot") for one in (file, first))
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
