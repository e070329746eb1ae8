"""What a run's files hold and where, without their messages.

A record of an hour has 2 GiB and, read whole, ten times that in memory. So its files are skimmed
once, and `tools/runs/run_log.py` reads the parts that are needed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from shared.exceptions import RunError
from shared.mcap_log.reader import ChunkPlace, LogReader, LogRecord, LostBytes, open_log
from shared.mcap_log.records import Attachment, Channel, Metadata
from shared.mcap_log.writer import SCHEMA_VERSION
from tools.runs.run_files import files_in

_OFFSET: Final = re.compile(r"-?[0-9]{1,19}")
_CLOCK_MAX_NS: Final = 1 << 62
"""More than any monotonic clock shows."""


class FilePlaces(NamedTuple):
    """Where one file has its messages."""

    path: Path
    chunks: list[ChunkPlace]
    keys: dict[int, str]
    """Full key of each channel."""

    def among(self, begin_ns: int, end_ns: int, keys: frozenset[str] | None) -> list[ChunkPlace]:
        """Return the chunks that may hold messages of a time and of some keys.

        The first chunk is always among them: it holds the channels again.

        Args:
            begin_ns: log time, inclusive.
            end_ns: log time, exclusive.
            keys: full keys; None: all.
        """
        others = {n for n, key in self.keys.items() if keys is not None and key not in keys}
        return [
            chunk
            for number, chunk in enumerate(self.chunks)
            if number == 0
            or (
                chunk.last_ns >= begin_ns
                and chunk.first_ns < end_ns
                and not (chunk.channels is not None and chunk.channels <= others)
            )
        ]


class RunIndex:
    """A run's files: what is said about it, and the places of its messages."""

    def __init__(self, path: Path) -> None:
        """Skim a file, or the files of the run in a directory.

        Raises:
            RunError: a file is missing, empty, no MCAP file or no run; or the directory holds
                no run, or several.
        """
        self.path = path
        self.files = files_in(path) if path.is_dir() else [path]
        """The files of the run, in order: several if it was split."""
        self.metadata: dict[str, dict[str, str]] = {}
        """Metadata records by name: `run`, `clock`, `packages`, at the end `counts`."""
        self.attachments: dict[str, bytes] = {}
        self.complete = True
        """True if the recorder finished every file; False if it was killed."""
        self.damage: list[LostBytes] = []
        """Places that could not be read: their contents are left out."""
        self.cut: LostBytes | None = None
        """What follows the last whole record of a file that was cut off."""
        self.places = [self._skim(file) for file in self.files]
        self._check_version(self.required("run", "schema_version"))
        self.robot = self.required("run", "robot")
        offset = self.required("clock", "offset_ns")
        if not _OFFSET.fullmatch(offset):
            raise RunError(f"{path}: clock.offset_ns is {offset[:40]!r}; an integer is right")
        self.offset_ns = int(offset)
        """wall clock in ns since 1970 = `t_ns` of a message + `offset_ns`."""
        chunks = [chunk for file in self.places for chunk in file.chunks]
        self.began_ns = min((chunk.first_ns for chunk in chunks), default=self.offset_ns)
        """Log time of the first message."""
        self.ended_ns = max((chunk.last_ns for chunk in chunks), default=self.offset_ns)
        """Log time of the last message."""
        if max(abs(t - self.offset_ns) for t in (self.began_ns, self.ended_ns)) > _CLOCK_MAX_NS:
            raise RunError(f"{path}: its times and clock.offset_ns do not fit each other")

    @property
    def length_s(self) -> float:
        """Time from the first message to the last."""
        return (self.ended_ns - self.began_ns) / 1e9

    def required(self, record: str, field: str) -> str:
        """Return a field of a metadata record.

        Raises:
            RunError: the run has none.
        """
        value = self.metadata.get(record, {}).get(field)
        if value is None:
            raise RunError(
                f"{self.path}: no metadata {record}.{field}; an MCAP file written by "
                "services.recorder, not cut off before its first message, is right"
            )
        return value

    def records(
        self, begin_ns: int, end_ns: int, keys: frozenset[str] | None = None
    ) -> Iterator[tuple[LogRecord, FilePlaces]]:
        """Yield the chunks that may hold messages of a time and of some keys, with their file.

        What turns out damaged is left out and noted.
        """
        for file in self.places:
            wanted = file.among(begin_ns, end_ns, keys)
            if not wanted:
                continue
            with open_log(file.path) as reader:
                for place in wanted:
                    record = self._read(reader, file.path, place)
                    if record is not None:
                        self._learn(record, file)
                        yield record, file
                self.damage += [loss for loss in reader.damage if loss not in self.damage]

    @staticmethod
    def _read(reader: LogReader, path: Path, place: ChunkPlace) -> LogRecord | None:
        try:
            return reader.read_at(place.start)
        except RunError as error:
            raise RunError(f"{path}: {error}") from None

    def _skim(self, path: Path) -> FilePlaces:
        file = FilePlaces(path, [], {})
        with open_log(path) as reader:
            for found in reader.skim():
                if isinstance(found, ChunkPlace):
                    file.chunks.append(found)
                else:
                    self._learn(found, file)
            self.complete = self.complete and reader.finished
            self.damage += reader.damage
            self.cut = reader.cut or self.cut
        return file

    def _learn(self, record: LogRecord, file: FilePlaces) -> None:
        for value in record.values():
            match value:
                case Metadata(name=name, metadata=entries):
                    self.metadata[name] = entries
                case Attachment(name=name, data=data):
                    self.attachments[name] = data
                case Channel(id=number, topic=topic):
                    file.keys[number] = topic

    def _check_version(self, version: str) -> None:
        if version != SCHEMA_VERSION:
            raise RunError(
                f"{self.path}: the log has schema version {version}, and this code reads "
                f"{SCHEMA_VERSION}: read it with the checkout that wrote it"
            )
