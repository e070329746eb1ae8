"""One MCAP file of a run: what it says, and where its messages are; they are read when needed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from shared.exceptions import RunError
from shared.mcap_log.reader import ChunkPlace, LogRecord, LostBytes, open_log
from shared.mcap_log.records import Attachment, Channel, Metadata
from tools.logs.run_files import MetadataByName

_OFFSET: Final = re.compile(r"-?[0-9]{1,20}")
_EVER: Final = 1 << 64
_CLOCK_MAX_NS: Final = 1 << 62
"""More than any monotonic clock shows."""


class RecordedFile:
    """A file, skimmed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: MetadataByName = {}
        """Metadata records by name: `run`, `clock`, `packages`, at the end `counts`."""
        self.attachments: dict[str, bytes] = {}
        self.keys: dict[int, str] = {}
        """Full key of each channel."""
        self.chunks: list[ChunkPlace] = []
        self.damage: list[LostBytes] = []
        """Places that could not be read, as far as they have been read."""
        with open_log(path) as reader:
            for found in reader.skim():
                if isinstance(found, ChunkPlace):
                    self.chunks.append(found)
                else:
                    self._learn(found)
            self.finished = reader.finished
            """The recorder wrote the end of the file."""
            self.cut = reader.cut
            """What follows the last whole record of a file that was cut off."""
            self.damage += reader.damage

    def required(self, record: str, field: str) -> str:
        """Return a field of a metadata record."""
        value = self.metadata.get(record, {}).get(field)
        if value is None:
            raise RunError(
                f"{self.path}: no metadata {record}.{field}; an MCAP file written by "
                "services.recorder, not cut off before its first message, is right"
            )
        return value

    @property
    def offset_ns(self) -> int:
        """Wall clock in ns since 1970 = `t_ns` of a message + this."""
        text = self.required("clock", "offset_ns")
        if not _OFFSET.fullmatch(text):
            raise RunError(f"{self.path}: clock.offset_ns is {text[:40]!r}; an integer is right")
        offset_ns = int(text)
        if max(abs(t - offset_ns) for t in self.span_ns or (offset_ns,)) > _CLOCK_MAX_NS:
            raise RunError(f"{self.path}: its times and clock.offset_ns do not fit each other")
        return offset_ns

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Log times of the first and the last message; None without any."""
        if not self.chunks:
            return None
        return min(c.first_ns for c in self.chunks), max(c.last_ns for c in self.chunks)

    def keys_with_messages(self) -> list[str]:
        """Return the keys that have a message, in the order of their channels."""
        known = {n for chunk in self.chunks if chunk.channels is not None for n in chunk.channels}
        if any(chunk.channels is None for chunk in self.chunks):
            known |= {row.channel_id for record in self.records(0, _EVER) for row in record.rows}
        return [self.keys[number] for number in sorted(known) if number in self.keys]

    def records(
        self, begin_ns: int, end_ns: int, keys: frozenset[str] | None = None
    ) -> Iterator[LogRecord]:
        """Yield chunks that may hold messages of a log time (end exclusive) and of some keys."""
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
        """Return the chunks to read; the first is always among them: it has the channels again."""
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
