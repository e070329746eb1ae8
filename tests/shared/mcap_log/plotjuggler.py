"""What PlotJuggler asks of an MCAP file with JSON in it, written down from its sources.

PlotJuggler is C++ on Qt and comes as snap, AppImage or ROS package: the tests cannot install it.
Its rules are followed here record by record, of two versions:

3 (3.9 to 3.17, facontidavide/PlotJuggler): plotjuggler_plugins/DataLoadMCAP/dataload_mcap.cpp
(db606ba) and plotjuggler_app/nlohmann_parsers.cpp (e02aceb). The file needs its summary. A channel
without a schema ends the load. A parser is chosen by the channel's message encoding, else by its
schema's; for JSON the schema is not read. Numbers and booleans become doubles; strings, null, and
empty arrays and objects are dropped.

4 (PlotJuggler/pj-official-plugins): data_load_mcap/mcap_source.cpp and mcap_dialog.hpp (1.2) and
parser_json/json_parser.cpp (1.1.1, the strictest after 1.1.0; later ones make doubles of all
numbers). Chosen from the start is each channel of which the statistics count a message. Arrays are
cut after 500 entries, as the dialog has it at first; null is dropped. A column has the type of its
first value: bool, integer, float or string; a message with another one is refused, all of it.

Only the rules for JSON are here. Messages in protobuf and CDR, such as those of a scene, are left
to PlotJuggler's own parsers of these, by name (`Opened.left`).
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NoReturn

from mcap.reader import make_reader
from mcap.summary import Summary

PARSERS_3: Final = frozenset({"json", "cbor", "bson", "msgpack", "protobuf", "ros1msg", "ros2msg"})
PARSERS_4: Final = PARSERS_3 | {"cdr", "omgidl", "data_tamer"}
JSON: Final = "json"
MAGIC: Final = b"\x89MCAP0\r\n"
ARRAY_MAX: Final = 500
INTEGER_MAX: Final = 1 << 53
"""Beyond it a double is not every integer."""


class Refused(Exception):  # noqa: N818 - a finding about a file
    """A version does not open the file."""


@dataclass
class Opened:
    """What both versions read of a file, and what one of them would lose."""

    messages: Counter[str] = field(default_factory=Counter)
    """Messages that were read, by topic."""
    left: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Topics that another parser reads than that of JSON, and its name in 3 and in 4."""
    lost: dict[str, str] = field(default_factory=dict)
    """Why, by the path of a value or the topic of a channel; strings are meant to be lost."""


def opened(path: Path) -> Opened:
    """Open a file as both versions do; Refused if one of them does not."""
    found, chosen = Opened(), set[str]()
    summary, counts = _summary(path)
    for channel in summary.channels.values():
        schema = summary.schemas.get(channel.schema_id)
        if schema is None:
            raise Refused(f"{channel.topic}: schema {channel.schema_id} is not there")
        encoding = channel.message_encoding
        by_3 = next((name for name in (encoding, schema.encoding) if name in PARSERS_3), None)
        if by_3 is None or encoding not in PARSERS_4:
            found.lost[channel.topic] = "no parser"
        elif encoding != JSON:
            found.left[channel.topic] = by_3, encoding
        elif counts.get(channel.id):
            chosen.add(channel.topic)
    types: dict[str, type] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.topic not in chosen:
                continue
            found.messages[channel.topic] += 1
            payload = _parsed(channel.topic, message.data)
            for name, value in _leaves(channel.topic, payload, found.lost):
                if types.setdefault(name, type(value)) is not type(value):
                    found.lost[name] = "of another type than before"
                if isinstance(value, int) and abs(value) > INTEGER_MAX:
                    found.lost[name] = "rounded to a double"
    return found


def _summary(path: Path) -> tuple[Summary, dict[int, int]]:
    """Return the summary, and the messages of each channel by its statistics."""
    with path.open("rb") as file:
        file.seek(-len(MAGIC), os.SEEK_END)
        if file.read() != MAGIC:
            raise Refused("no summary: the file has no end")
        file.seek(0)
        summary = make_reader(file).get_summary()
    if summary is None or summary.statistics is None:
        raise Refused("no summary, or no statistics in it")
    return summary, summary.statistics.channel_message_counts


def _parsed(topic: str, data: bytes) -> Any:
    def no_number(text: str) -> NoReturn:
        raise Refused(f"{topic}: {text} is no JSON")

    try:
        return json.loads(data, parse_constant=no_number)
    except ValueError as error:
        raise Refused(f"{topic}: no JSON: {error}") from None


def _leaves(path: str, value: Any, lost: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """Yield (path, value) of each value below a path."""
    if value is None or value in ([], {}):
        lost[path] = "null, or without entries"
    elif isinstance(value, dict):
        for name, entry in value.items():
            yield from _leaves(f"{path}/{name}", entry, lost)
    elif isinstance(value, list):
        if len(value) > ARRAY_MAX:
            lost[path] = "cut off"
        for number, entry in enumerate(value):
            yield from _leaves(f"{path}[{number}]", entry, lost)
    else:
        yield path, value
