"""Index of a run's files: metadata, attachments, and the places of the messages.

A record of one hour takes 0.8 GiB, and ten times that in memory. So its files are skimmed
once, and `tools/logs/run_log.py` reads only the needed parts. A split run consists of several files
in one directory.
"""

from __future__ import annotations

import contextlib
import re
import tomllib
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Final

from shared.bus.topics import RECORDER
from shared.config.robot_config import SERVICES
from shared.exceptions import RunError
from shared.mcap_log.files import SUFFIX
from shared.mcap_log.reader import ChunkPlace, LogRecord, LostBytes, open_log
from shared.mcap_log.records import Attachment, Channel, Metadata
from shared.mcap_log.writer import SCHEMA_VERSION
from shared.toml_file import decoded

THIS_HOST: Final = "this host"
"""Host name of services whose endpoint is a socket in the file system."""
_HOST: Final = re.compile(r"(?:tls|tcp)/(\[[^\]]+\]|[^:]+):")
_OFFSET: Final = re.compile(r"-?[0-9]{1,20}")
_EVER: Final = 1 << 64
_CLOCK_MAX_NS: Final = 1 << 62
"""Larger than any value of a monotonic clock."""

MetadataByName = dict[str, dict[str, str]]


def head_of(path: Path) -> MetadataByName:
    """Return the metadata at the start of a file, up to its first messages."""
    found: MetadataByName = {}
    with open_log(path) as reader:
        for record in reader:
            if record.rows:
                break
            if isinstance(record.value, Metadata):
                found[record.value.name] = record.value.metadata
    return found


def files_of_run(path: Path, metadata: MetadataByName) -> list[Path]:
    """Return the files of the run to which a file belongs, in order, including that file.

    A recovered copy is used only if the original is missing.
    """
    run = metadata.get("split", {}).get("run")
    if not run:
        return [path]
    numbers = {path: _number(metadata)}
    for other in _names(path.parent):
        if other.resolve() == path.resolve():
            continue
        with contextlib.suppress(RunError):
            head = head_of(other)
            number = _number(head)
            if head.get("split", {}).get("run") == run and number not in numbers.values():
                numbers[other] = number
    return sorted(numbers, key=lambda file: numbers[file])


def files_in(directory: Path) -> list[Path]:
    """Return the files of the run in a directory, in order; raise RunError for several runs."""
    runs = _runs_in(directory)
    if len(runs) > 1:
        first = ", ".join(run[0].name for run in runs)
        raise RunError(
            f"{directory}: contains {len(runs)} runs ({first}); give the files of one run"
        )
    return runs[0]


def _runs_in(directory: Path) -> list[list[Path]]:
    """Return the files of each run in a directory; a restarted recorder begins a new run."""
    names = _names(directory)
    plain = [path for path in names if "." not in path.stem]  # not recovered or re-executed
    runs: list[list[Path]] = []
    unreadable: RunError | None = None
    for path in plain or names:
        if any(path in run for run in runs):
            continue
        try:
            runs.append(files_of_run(path, head_of(path)))
        except RunError as error:
            unreadable = error
    if not runs:
        raise unreadable or RunError(f"{directory}: has no {SUFFIX} file; give a run's directory")
    return runs


def _names(directory: Path) -> list[Path]:
    return sorted(directory.glob(f"*{SUFFIX}"), key=lambda path: (len(path.name), path.name))


def _number(metadata: MetadataByName) -> int:
    text = metadata.get("split", {}).get("number", "")
    return int(text) if text.isdecimal() and text.isascii() and len(text) < 10 else 0


class _RecordedFile:
    """A skimmed file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: MetadataByName = {}
        """Metadata records by name: `run`, `clock`, `packages`, and at the end `counts`."""
        self.attachments: dict[str, bytes] = {}
        self.keys: dict[int, str] = {}
        """Full key of each channel."""
        self.chunks: list[ChunkPlace] = []
        self.damage: list[LostBytes] = []
        """Unreadable places found so far."""
        with open_log(path) as reader:
            for found in reader.skim():
                if isinstance(found, ChunkPlace):
                    self.chunks.append(found)
                else:
                    self._learn(found)
            self.finished = reader.finished
            """True if the recorder wrote the end of the file."""
            self.cut = reader.cut
            """Bytes after the last whole record, if the file was cut off; else None."""
            self.damage += reader.damage

    def required(self, record: str, field: str) -> str:
        """Return a field of a metadata record."""
        value = self.metadata.get(record, {}).get(field)
        if value is None:
            raise RunError(
                f"{self.path}: no metadata {record}.{field}; must be an MCAP file written by "
                "services.recorder that was not cut off before its first message"
            )
        return value

    @property
    def offset_ns(self) -> int:
        """Wall clock, ns since 1970, minus the `t_ns` of a message."""
        text = self.required("clock", "offset_ns")
        if not _OFFSET.fullmatch(text):
            raise RunError(f"{self.path}: clock.offset_ns is {text[:40]!r}; must be an integer")
        offset_ns = int(text)
        if max(abs(t - offset_ns) for t in self.span_ns or (offset_ns,)) > _CLOCK_MAX_NS:
            raise RunError(f"{self.path}: its times contradict clock.offset_ns; it is damaged")
        return offset_ns

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Log times of the first and the last message, or None without messages."""
        if not self.chunks:
            return None
        return min(c.first_ns for c in self.chunks), max(c.last_ns for c in self.chunks)

    def keys_with_messages(self) -> set[str]:
        """Return the keys that have a message."""
        known = {n for chunk in self.chunks if chunk.channels is not None for n in chunk.channels}
        if any(chunk.channels is None for chunk in self.chunks):
            known |= {row.channel_id for record in self.records(0, _EVER) for row in record.rows}
        return {self.keys[number] for number in known if number in self.keys}

    def records(
        self, begin_ns: int, end_ns: int, keys: frozenset[str] | None = None
    ) -> Iterator[LogRecord]:
        """Yield chunks that may contain messages of some keys at a log time (end exclusive)."""
        wanted = self._among(begin_ns, end_ns, keys)
        if not wanted:
            return
        with open_log(self.path) as reader:
            for place in wanted:
                try:
                    record = reader.read_at(place.start)
                except RunError as error:
                    raise RunError(f"{self.path}: {error}") from None
                if record is not None:
                    self._learn(record)
                    yield record
            self.damage += [loss for loss in reader.damage if loss not in self.damage]

    def _among(self, begin_ns: int, end_ns: int, keys: frozenset[str] | None) -> list[ChunkPlace]:
        """Return the chunks to read, including the first, because it repeats the channels."""
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

    def _learn(self, record: LogRecord) -> None:
        for value in record.values():
            match value:
                case Metadata(name=name, metadata=entries):
                    self.metadata[name] = entries
                case Attachment(name=name, data=data):
                    self.attachments[name] = data
                case Channel(id=number, topic=topic):
                    self.keys[number] = topic


class RunIndex:
    """A run's files: their metadata, and the places of their messages."""

    def __init__(self, path: Path, files: Sequence[Path] = ()) -> None:
        self.path = path
        self.files = list(files) or (files_in(path) if path.is_dir() else [path])
        """The files of the run, in order; several if it was split."""
        self._files = [_RecordedFile(file) for file in self.files]
        first = self._files[0]
        version = first.required("run", "schema_version")
        if version != SCHEMA_VERSION:
            raise RunError(
                f"{path}: the log has schema version {version}, but this code reads "
                f"{SCHEMA_VERSION}: read it with the checkout that wrote it"
            )
        self.robot = first.required("run", "robot")
        self.offset_ns = first.offset_ns
        """Wall clock, ns since 1970, minus the `t_ns` of a message."""
        spans = [file.span_ns for file in self._files if file.span_ns is not None]
        self.began_ns = min((begin for begin, _ in spans), default=self.offset_ns)
        """Log time of the first message."""
        self.ended_ns = max((end for _, end in spans), default=self.offset_ns)
        """Log time of the last message."""

    @property
    def span_ns(self) -> tuple[int, int]:
        """Times of the first and the last message, monotonic clock of the recorder."""
        return self.began_ns - self.offset_ns, self.ended_ns - self.offset_ns

    @property
    def length_s(self) -> float:
        """Time from the first message to the last, s."""
        return (self.ended_ns - self.began_ns) / 1e9

    @property
    def metadata(self) -> MetadataByName:
        """Metadata records by name: `run`, `clock`, `packages`, and at the end `counts`."""
        return dict(chain.from_iterable(file.metadata.items() for file in self._files))

    @property
    def attachments(self) -> dict[str, bytes]:
        """Attached files by name."""
        return dict(chain.from_iterable(file.attachments.items() for file in self._files))

    def keys_with_messages(self) -> set[str]:
        """Return the keys that have a message."""
        return {key for file in self._files for key in file.keys_with_messages()}

    @property
    def hosts(self) -> dict[str, str]:
        """Host of each service in the attached robot file; empty if the file names no hosts."""
        text = self.attachments.get("robot.toml", b"")
        try:
            endpoints = tomllib.loads(decoded(text)).get("bus", {}).get("endpoints", {}).items()
        except (tomllib.TOMLDecodeError, UnicodeError, AttributeError, RecursionError):
            return {}
        return {
            service: found[1].strip("[]") if (found := _HOST.match(endpoint)) else THIS_HOST
            for service, endpoint in endpoints
            if service in SERVICES and isinstance(endpoint, str)
        }

    @property
    def recorded_beside(self) -> str:
        """Name of a service on the host of this record; each host may have a recorder."""
        return self.metadata["run"].get("of", "").partition(",")[0] or RECORDER

    @property
    def complete(self) -> bool:
        """True if the recorder finished every file; False if it was killed."""
        return all(file.finished for file in self._files)

    @property
    def damage(self) -> list[LostBytes]:
        """Unreadable places found so far; their messages are left out."""
        return [loss for file in self._files for loss in file.damage]

    @property
    def cut(self) -> LostBytes | None:
        """Bytes after the last whole record of a file that was cut off, or None."""
        return next((file.cut for file in reversed(self._files) if file.cut is not None), None)

    def records(
        self, begin_ns: int, end_ns: int, keys: frozenset[str] | None = None
    ) -> Iterator[tuple[LogRecord, dict[int, str]]]:
        """Yield the chunks of `_RecordedFile.records`, each with the full keys of its channels."""
        for file in self._files:
            for record in file.records(begin_ns, end_ns, keys):
                yield record, file.keys
