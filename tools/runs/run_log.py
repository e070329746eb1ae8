"""Reads a run's MCAP file, or all of its files, into memory: finished or killed.

A killed file has no summary, and may end in the middle of a record; the readers of the mcap package
find nothing in the first and may stumble over the second (docs/logs.md). `shared.mcap_log.reader`
walks the records from the start and keeps every whole one; here they are sorted by key.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from shared.bus.topics import Topic
from shared.exceptions import RunError
from shared.mcap_log.reader import LogRecord, LostBytes, open_log
from shared.mcap_log.records import Attachment, Channel, Metadata
from shared.mcap_log.sequence_stats import KeyCount
from shared.mcap_log.writer import SCHEMA_VERSION
from tools.runs.run_files import files_in


class Series:
    """The messages of one key, in the order in which they were recorded."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        self.received_ns: list[int] = []
        """Reception by the recorder, monotonic clock (once the offset is taken off)."""
        self.seq: list[int] = []
        self.decoded: list[Any] | None = None


class RunLog:
    """A run in memory: about 2.5 MB for each second of the whole fleet.

    Messages are decoded on request, once for each key.
    """

    def __init__(self, path: Path) -> None:
        """Read a file, or the run in a directory; `read_run` is the name to use.

        Raises:
            RunError: a file is missing, empty, no MCAP file or no run; or the directory holds
                no run, or several.
        """
        self.path = path
        self.files = files_in(path) if path.is_dir() else [path]
        """The files read, in order: several if the run was split."""
        self.metadata: dict[str, dict[str, str]] = {}
        """Metadata records by name: `run`, `clock`, `packages`, at the end `counts`."""
        self.attachments: dict[str, bytes] = {}
        self.complete = True
        """True if the recorder finished every file; False if it was killed."""
        self.damage: list[LostBytes] = []
        """Places that could not be read: their contents are left out."""
        self.cut: LostBytes | None = None
        """What follows the last whole record of a file that was cut off."""
        self._series: dict[str, Series] = {}
        self._by_channel: dict[int, Series] = {}
        for file in self.files:
            self._read(file)
        self._check_version(self._required("run", "schema_version"))
        self.robot = self._required("run", "robot")
        offset = self._required("clock", "offset_ns")
        if not offset.lstrip("-").isdecimal():
            raise RunError(f"{path}: clock.offset_ns is {offset!r}; an integer is right")
        self.offset_ns = int(offset)
        """wall clock in ns since 1970 = `t_ns` of a message + `offset_ns`."""
        for series in self._series.values():
            series.received_ns = [t - self.offset_ns for t in series.received_ns]

    def _check_version(self, version: str) -> None:
        if version != SCHEMA_VERSION:
            raise RunError(
                f"{self.path}: the log has schema version {version}, and this code reads "
                f"{SCHEMA_VERSION}: read it with the checkout that wrote it"
            )

    @property
    def damaged(self) -> int:
        """Number of places in the middle of the file that could not be read."""
        return len(self.damage)

    def keys(self) -> list[str]:
        """Return every key that has at least one message."""
        return [key for key, series in self._series.items() if series.payloads]

    def count(self, key: str) -> int:
        """Return the number of messages on a key; 0 for a key that is not in the file."""
        return len(self._of(key).payloads)

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        """Return the messages of a topic as `topic.type`, in the order of the file.

        Args:
            topic: a row of `shared.bus.topics`.
            module: for a topic with one key for each module.

        Raises:
            RunError: a message is not of that type: another version wrote the file;
                or a module is needed and missing, or the other way round.
        """
        key = self._key(topic, module)
        series = self._of(key)
        if series.decoded is None:
            decode = msgspec.json.Decoder(topic.type).decode
            try:
                series.decoded = [decode(payload) for payload in series.payloads]
            except (msgspec.DecodeError, UnicodeDecodeError) as error:
                version = self.metadata["run"].get("schema_version", "unknown")
                raise RunError(
                    f"{self.path}: {key}: a message is no {topic.type.__name__}: {error}; "
                    f"the file has schema version {version}: read it with the code that wrote it"
                ) from None
        return series.decoded

    def raw(self, key: str) -> list[tuple[int, bytes, int]]:
        """Return (monotonic reception, payload, number) of every message of a key."""
        series = self._of(key)
        return list(zip(series.received_ns, series.payloads, series.seq, strict=True))

    def began_ns(self) -> int:
        """Return when the first message reached the recorder, monotonic clock; 0 if none did."""
        begun = [one.received_ns[0] for one in self._series.values() if one.received_ns]
        return min(begun, default=0)

    def received_ns(self, topic: Topic, module: str = "") -> list[int]:
        """Return when each of `messages(topic, module)` reached the recorder.

        Monotonic clock of the recorder's host: comparable with `t_ns` of senders there.
        """
        return self._of(self._key(topic, module)).received_ns

    def gaps(self) -> dict[str, KeyCount]:
        """Return counts, gaps and restarts of every key with messages, from the file itself."""
        found = {}
        for key in self.keys():
            found[key] = KeyCount()
            for seq in self._of(key).seq:
                found[key].feed(seq)
        return found

    def _read(self, file: Path) -> None:
        self._by_channel = {}
        with open_log(file) as reader:
            for record in reader:
                self._take(record)
            self.complete = self.complete and reader.finished
            self.damage += reader.damage
            self.cut = reader.cut or self.cut

    def _key(self, topic: Topic, module: str) -> str:
        if topic.per_module != bool(module):
            right = "name a module" if topic.per_module else "name none"
            raise RunError(f"{topic.name}: module {module!r} does not fit this topic; {right}")
        return topic.key(self.robot, module)

    def _of(self, key: str) -> Series:
        return self._series.get(key) or Series()

    def _required(self, record: str, field: str) -> str:
        value = self.metadata.get(record, {}).get(field)
        if value is None:
            raise RunError(
                f"{self.path}: no metadata {record}.{field}; an MCAP file written by "
                "services.recorder, not cut off before its first message, is right"
            )
        return value

    def _take(self, record: LogRecord) -> None:
        for value in record.values():
            match value:
                case Metadata(name=name, metadata=entries):
                    self.metadata[name] = entries
                case Attachment(name=name, data=data):
                    self.attachments[name] = data
                case Channel(id=number, topic=topic):
                    self._by_channel[number] = self._series.setdefault(topic, Series())
        self._take_messages(record)

    def _take_messages(self, record: LogRecord) -> None:
        """Sort messages by channel; the hot loop of reading."""
        body, by_channel = record.body, self._by_channel
        for channel, seq, log_ns, _, start, end in record.rows:
            series = by_channel.get(channel)
            if series is not None:
                series.payloads.append(body[start:end])
                series.received_ns.append(log_ns)
                series.seq.append(seq)


def read_run(path: Path) -> RunLog:
    """Read a run, finished or killed.

    Args:
        path: a file; or a directory: all files of the run in it.

    Raises:
        RunError: a file is missing, empty, no MCAP file or no run; or the directory holds no
            run, or several.
    """
    return RunLog(path)
