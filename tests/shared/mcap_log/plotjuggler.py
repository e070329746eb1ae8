"""PlotJuggler's rules for an MCAP file with JSON in it, written down from its sources.

PlotJuggler is C++ on Qt and comes as snap, AppImage or ROS package: the tests cannot install it.
What it does with a file is followed here record by record. Two readers:

`opened_by_3`: PlotJuggler 3.9 to 3.17 (facontidavide/PlotJuggler), of
plotjuggler_plugins/DataLoadMCAP/dataload_mcap.cpp (db606ba) and
plotjuggler_app/nlohmann_parsers.cpp (e02aceb). The file needs its summary. Every channel's schema
is looked up; one that is missing ends the load. A parser is chosen by the channel's message
encoding, else by its schema's; for JSON the schema is not read. Objects go down by `/`, arrays by
`[i]`, and the last entry again as `[-1]`, whatever their length. Numbers and booleans become
doubles; strings, null, and empty arrays and objects are dropped. A message is at its publish time,
a double of seconds. What is not finite is dropped.

`opened_by_4`: PlotJuggler 4 (PlotJuggler/pj-official-plugins), of data_load_mcap/mcap_source.cpp
and mcap_dialog.hpp (1.2) and parser_json/json_parser.cpp (1.1.1, the strictest after 1.1.0; later
ones make doubles of all numbers). Chosen from the start is each channel of which the statistics
count a message. A schema that is named and missing leaves its channel out; none at all is right.
Arrays are cut after 500 entries, as the dialog has it at first. Strings of 100 bytes and more are
dropped, and null. A column has the type of its first value: bool, integer, float or string; a
message with another one is refused, all of it. A message is at its publish time if that is within
the file's log times, else at its log time.

Only the rules for JSON are here. Messages in protobuf and CDR, such as those of a scene, are left
to PlotJuggler's own parsers of these, by name (`Opened.left`).
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NoReturn

from mcap.reader import make_reader
from mcap.records import Message
from mcap.summary import Summary

PARSERS_3: Final = frozenset({"json", "cbor", "bson", "msgpack", "protobuf", "ros1msg", "ros2msg"})
PARSERS_4: Final = PARSERS_3 | {"cdr", "omgidl", "data_tamer"}
JSON: Final = "json"
MAGIC: Final = b"\x89MCAP0\r\n"
ARRAY_MAX: Final = 500
TEXT_MAX: Final = 100
LAST: Final = "[-1]"


class Refused(Exception):  # noqa: N818 - a finding about a file
    """PlotJuggler does not open the file."""


@dataclass
class Opened:
    """What is on the list of series, and what is not."""

    points: dict[str, list[tuple[float, Any]]] = field(default_factory=dict)
    """(s since 1970, value) by series."""
    words: Counter[str] = field(default_factory=Counter)
    """Strings that were dropped, by path."""
    holes: Counter[str] = field(default_factory=Counter)
    """null, or an array or an object without entries, by path."""
    cut: Counter[str] = field(default_factory=Counter)
    """Entries of arrays that were cut off, by path."""
    refused: Counter[str] = field(default_factory=Counter)
    """Messages that were refused, by the path that was of another type than before."""
    unread: dict[str, str] = field(default_factory=dict)
    """Topics that are not read, and why."""
    left: dict[str, str] = field(default_factory=dict)
    """Topics that another of its parsers reads than that of JSON, and the parser's name."""
    messages: Counter[str] = field(default_factory=Counter)
    """Messages that were read, by topic."""

    def add(self, name: str, t_s: float, value: Any) -> None:
        """Take a point; one that is not finite is dropped as PlotJuggler drops it."""
        if isinstance(value, str) or (math.isfinite(t_s) and math.isfinite(value)):
            self.points.setdefault(name, []).append((t_s, value))


def opened_by_3(path: Path) -> Opened:
    """Open a file as PlotJuggler 3 does, or raise Refused."""
    found = Opened()
    summary = _summary(path)
    for channel in summary.channels.values():
        described = summary.schemas.get(channel.schema_id)
        if described is None:
            raise Refused(f"{channel.topic}: schema {channel.schema_id} is not there")
        names = (channel.message_encoding, described.encoding)
        parser = next((name for name in names if name in PARSERS_3), None)
        if parser is None:
            found.unread[channel.topic] = "no parser"
        elif parser != JSON:
            found.left[channel.topic] = parser
    for topic, message in _messages(path, summary):
        if topic not in found.unread and topic not in found.left:
            t_s = float(message.publish_time) * 1e-9
            _flatten_3(found, topic, _parsed(topic, message.data), t_s)
            found.messages[topic] += 1
    for row in found.points.values():
        row.sort(key=lambda point: point[0])
    return found


def opened_by_4(path: Path) -> Opened:
    """Open a file as PlotJuggler 4 does, or raise Refused: it has no summary, or is no JSON."""
    found = Opened()
    summary = _summary(path)
    statistics = summary.statistics
    if statistics is None:
        raise Refused("no statistics")
    for channel in summary.channels.values():
        if not statistics.channel_message_counts.get(channel.id):
            found.unread[channel.topic] = "not chosen: no messages"
        elif channel.schema_id and channel.schema_id not in summary.schemas:
            found.unread[channel.topic] = f"schema {channel.schema_id} is not there"
        elif channel.message_encoding not in PARSERS_4:
            found.unread[channel.topic] = "no parser"
        elif channel.message_encoding != JSON:
            found.left[channel.topic] = channel.message_encoding
    first_ns, last_ns = statistics.message_start_time, statistics.message_end_time
    types: dict[str, type] = {}
    for topic, message in _messages(path, summary):
        if topic in found.unread or topic in found.left:
            continue
        within = first_ns <= message.publish_time <= last_ns
        t_s = (message.publish_time if within else message.log_time) * 1e-9
        fields = list(_flat_4(found, topic, _parsed(topic, message.data)))
        strange = [
            name for name, value in fields if types.setdefault(name, type(value)) is not type(value)
        ]
        if strange:
            found.refused[strange[0]] += 1
            continue
        for name, value in fields:
            found.add(name, t_s, value)
        found.messages[topic] += 1
    return found


def _summary(path: Path) -> Summary:
    with path.open("rb") as file:
        file.seek(-len(MAGIC), os.SEEK_END)
        if file.read() != MAGIC:
            raise Refused("no summary: the file has no end")
        file.seek(0)
        summary = make_reader(file).get_summary()
    if summary is None:
        raise Refused("no summary")
    return summary


def _messages(path: Path, summary: Summary) -> Iterator[tuple[str, Message]]:
    """Yield (topic, message) in the order of the file."""
    topics = {number: channel.topic for number, channel in summary.channels.items()}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            yield topics[channel.id], message


def _parsed(topic: str, data: bytes) -> Any:
    def no_number(text: str) -> NoReturn:
        raise Refused(f"{topic}: {text} is no JSON")

    try:
        return json.loads(data, parse_constant=no_number)
    except ValueError as error:
        raise Refused(f"{topic}: no JSON: {error}") from None


def _flatten_3(found: Opened, path: str, value: Any, t_s: float) -> None:
    if value is None or value in ([], {}):
        found.holes[path] += 1
    elif isinstance(value, list):
        for number, entry in enumerate(value):
            _flatten_3(found, f"{path}[{number}]", entry, t_s)
        _flatten_3(found, path + LAST, value[-1], t_s)
    elif isinstance(value, dict):
        for name, entry in value.items():
            _flatten_3(found, f"{path}/{name}", entry, t_s)
    elif isinstance(value, str):
        found.words[path] += 1
    else:
        found.add(path, t_s, float(value))


def _flat_4(found: Opened, path: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, entry in value.items():
            yield from _flat_4(found, f"{path}/{name}", entry)
    elif isinstance(value, list):
        if len(value) > ARRAY_MAX:
            found.cut[path] += len(value) - ARRAY_MAX
        for number, entry in enumerate(value[:ARRAY_MAX]):
            yield from _flat_4(found, f"{path}[{number}]", entry)
    elif value is None:
        found.holes[path] += 1
    elif isinstance(value, str) and len(value.encode()) >= TEXT_MAX:
        found.words[path] += 1
    else:
        yield path, value
