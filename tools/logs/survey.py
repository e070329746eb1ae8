"""Count the contents of MCAP files by file and by topic, even of unfinished and foreign files."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from shared.bus.topics import several_may_write
from shared.clock import NS_PER_S
from shared.mcap_log.files import in_use
from shared.mcap_log.reader import ChunkPlace, LogReader, LogRecord, LostBytes, open_log
from shared.mcap_log.records import Attachment, Channel, Header, McapRecord, Metadata, Schema
from shared.mcap_log.sequence_stats import KeyCount
from shared.mcap_log.writer import COUNTS, PROFILE
from tools.logs.run_index import MetadataByName

_NEVER: Final = -1


class TopicFacts(msgspec.Struct, kw_only=True):
    """One topic, over all surveyed files."""

    schema: str
    nominal_hz: float
    """Rate in the recorder's table of topics; 0 for events, or if unknown."""
    bytes: int | None = 0
    """Total size of the payloads before compression, bytes; None if not read."""
    first_ns: int = _NEVER
    last_ns: int = _NEVER
    longest_gap_ns: int | None = 0
    """Longest gap between consecutive messages (our logs: sender's clock); None if not read."""
    sequence: KeyCount = msgspec.field(default_factory=KeyCount)

    @property
    def rate_hz(self) -> float | None:
        """Mean rate from the first to the last message."""
        span_ns = self.last_ns - self.first_ns
        return (self.sequence.count - 1) * NS_PER_S / span_ns if span_ns > 0 else None


class FileFacts(msgspec.Struct, kw_only=True):
    """One file."""

    path: Path
    size: int
    finished: bool
    in_use: bool
    """True if a recorder is writing it."""
    profile: str = ""
    library: str = ""
    messages: int = 0
    first_ns: int = _NEVER
    """Log time of the first message; -1 without messages."""
    last_ns: int = _NEVER
    orphans: int = 0
    """Number of messages whose channel the file does not describe."""
    passed_over: int = 0
    """Number of records of kinds that the format does not define."""
    attachments: dict[str, int] = msgspec.field(default_factory=dict)
    """Sizes by name."""
    metadata: MetadataByName = msgspec.field(default_factory=dict)
    counted: int | None = None
    """Number of messages according to the summary; None if it is missing or damaged."""
    earlier_ends: int = 0
    """Number of file ends with data after them: the writer finished the file more than once."""
    cut: LostBytes | None = None
    damage: list[LostBytes] = msgspec.field(default_factory=list)

    @property
    def ours(self) -> bool:
        """True for a log of this project, of any version."""
        return self.profile == PROFILE


class Survey:
    """Files and their combined topics; add the files of a run in order."""

    def __init__(self) -> None:
        self.files: list[FileFacts] = []
        self.topics: dict[str, TopicFacts] = {}

    @property
    def messages(self) -> int:
        """Number of messages in all files."""
        return sum(file.messages for file in self.files)

    @property
    def first_ns(self) -> int:
        """Log time of the first message; -1 without messages."""
        return min((f.first_ns for f in self.files if f.messages), default=_NEVER)

    @property
    def last_ns(self) -> int:
        """Log time of the last message; -1 without messages."""
        return max((f.last_ns for f in self.files if f.messages), default=_NEVER)

    def add(self, path: Path, *, by_index: bool = False) -> FileFacts:
        """Read a file; with `by_index`, use the recorder's counts in our finished logs.

        With those counts, a topic's times are exact to within a chunk, and damage is not searched
        for.
        """
        for take in (_Reading.skim, _Reading.read) if by_index else (_Reading.read,):
            with open_log(path) as reader:
                facts = FileFacts(
                    path=path, size=reader.size, finished=reader.finished, in_use=in_use(path)
                )
                taken = take(_Reading(facts, self.topics), reader)
                facts.cut, facts.damage = reader.cut, reader.damage
                facts.passed_over, facts.earlier_ends = reader.passed_over, reader.earlier_ends
                facts.counted = reader.message_count
            if taken:
                break
        self.files.append(facts)
        return facts


class _Reading:
    """A file while it is read."""

    def __init__(self, facts: FileFacts, topics: dict[str, TopicFacts]) -> None:
        self._facts, self._topics = facts, topics
        self._schemas: dict[int, str] = {0: ""}
        self._channels: dict[int, TopicFacts] = {}

    def read(self, reader: LogReader) -> bool:
        """Read every message; return True."""
        for record in reader:
            for value in record.values():
                self._take(value)
            if record.rows:
                self._count(record)
        if not self._facts.ours:
            # Other writers number messages as they like; rosbags writes only 0.
            for topic in self._channels.values():
                topic.sequence = KeyCount(count=topic.sequence.count, several=True)
        return True

    def skim(self, reader: LogReader) -> bool:
        """Use the recorder's counts; return False if they are missing or do not fit."""
        places: list[ChunkPlace] = []
        others: list[McapRecord] = []
        for found in reader.skim():
            if isinstance(found, ChunkPlace):
                places.append(found)
            else:
                others += found.values()
        names = {value.topic: value.id for value in others if isinstance(value, Channel)}
        counted = _counted(others, names, reader.message_count)
        if (
            not reader.finished
            or counted is None
            or any(place.channels is None for place in places)
        ):
            return False
        for value in others:
            self._take(value)
        if places:
            self._facts.first_ns = min(place.first_ns for place in places)
            self._facts.last_ns = max(place.last_ns for place in places)
        for key, count in counted.items():
            topic = self._channels[names[key]]
            within = [place for place in places if names[key] in (place.channels or ())]
            self._facts.messages += count.count
            topic.sequence.join(count)
            topic.bytes = topic.longest_gap_ns = None
            if within:
                first_ns = min(place.first_ns for place in within)
                topic.first_ns = first_ns if topic.first_ns == _NEVER else topic.first_ns
                topic.last_ns = max(place.last_ns for place in within)
        return True

    def _take(self, value: McapRecord) -> None:
        match value:
            case Header(profile=profile, library=library):
                self._facts.profile, self._facts.library = profile, library
            case Schema(id=number, name=name):
                self._schemas[number] = name
            case Channel():
                self._define(value)
            case Metadata(name=name, metadata=entries):
                self._facts.metadata[name] = entries
            case Attachment(name=name, data=data):
                self._facts.attachments[name] = len(data)

    def _define(self, channel: Channel) -> None:
        nominal_hz = 0.0
        with contextlib.suppress(ValueError):
            nominal_hz = float(channel.metadata.get("rate_hz", "0"))
        facts = TopicFacts(
            schema=self._schemas.get(channel.schema_id, ""),
            nominal_hz=nominal_hz,
            sequence=KeyCount(several=several_may_write(channel.topic)),
        )
        self._channels[channel.id] = self._topics.setdefault(channel.topic, facts)

    def _count(self, record: LogRecord) -> None:
        file, channels, ours = self._facts, self._channels, self._facts.ours
        for channel, seq, log_ns, publish_ns, start, end in record.rows:
            topic = channels.get(channel)
            if topic is None:
                file.orphans += 1
                continue
            if file.messages == 0:
                file.first_ns = file.last_ns = log_ns
            elif log_ns > file.last_ns:
                file.last_ns = log_ns
            elif log_ns < file.first_ns:
                file.first_ns = log_ns
            file.messages += 1
            topic.bytes = (topic.bytes or 0) + end - start
            topic.sequence.feed(seq)
            time_ns = publish_ns if ours else log_ns
            gap_ns = time_ns - topic.last_ns
            if topic.last_ns == _NEVER:
                topic.first_ns = time_ns
            elif gap_ns > (topic.longest_gap_ns or 0):
                topic.longest_gap_ns = gap_ns
            topic.last_ns = time_ns


def _counted(
    records: list[McapRecord], names: Mapping[str, int], total: int | None
) -> dict[str, KeyCount] | None:
    """Return the recorder's counts by key, or None if they do not fit the file.

    Another program may have dropped messages but copied the recorder's counts.
    """
    texts = next((m.metadata for m in records if isinstance(m, Metadata) and m.name == COUNTS), {})
    try:
        counts = {key: msgspec.json.decode(text, type=KeyCount) for key, text in texts.items()}
    except msgspec.DecodeError:
        return None
    counted = {key: count for key, count in counts.items() if count.count or key in names}
    fits = total is None or total == sum(count.count for count in counted.values())
    return counted if counted and fits and counted.keys() <= names.keys() else None
