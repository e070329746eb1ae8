"""A run's file with recomputed outputs in the place of the recorded ones."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Final

import msgspec
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer

from shared.atomic_file import atomic_file
from shared.bus import topics
from shared.bus.messages import Message
from shared.exceptions import RunError
from shared.mcap_log import schema
from shared.mcap_log.writer import PROFILE
from tools.logs.run_log import RunLog

_SEQUENCE_MASK: Final = 0xFFFFFFFF


def write(
    log: RunLog, path: Path, replaced: Mapping[str, Collection[Message]], note: Mapping[str, str]
) -> int:
    """Write a run with replaced messages; return the number of messages."""
    rows: list[tuple[int, str, bytes, int, int]] = []
    encode = msgspec.json.Encoder().encode
    for key in log.keys():  # noqa: SIM118 - a log is no mapping
        if key not in replaced:
            rows += [(t, key, data, t, seq) for t, data, seq in log.raw(key)]
    for key, messages in replaced.items():
        rows += [(m.t_ns, key, encode(m), m.t_ns, m.seq) for m in messages]
    rows.sort(key=lambda row: row[0])
    types = topics.all_keys(log.robot)
    try:
        with atomic_file(path, exclusive=True) as file:
            writer = Writer(file, compression=CompressionType.ZSTD)
            writer.start(profile=PROFILE)
            for name, entries in {**log.metadata, "resim": dict(note)}.items():
                writer.add_metadata(name, dict(entries))
            for name, content in log.attachments.items():
                writer.add_attachment(0, 0, name, "application/octet-stream", content)
            channels: dict[str, int] = {}
            for received_ns, key, data, t_ns, seq in rows:
                if key not in channels:
                    topic = types[key]
                    number = writer.register_schema(
                        schema.name_of(topic.type), schema.ENCODING, schema.encoded(topic.type)
                    )
                    channels[key] = writer.register_channel(key, MessageEncoding.JSON, number, {})
                writer.add_message(
                    channels[key],
                    received_ns + log.offset_ns,
                    data,
                    t_ns + log.offset_ns,
                    seq & _SEQUENCE_MASK,
                )
            finish: Callable[[], None] = writer.finish  # mcap leaves it without annotations
            finish()
    except FileExistsError:
        raise RunError(f"{path}: already exists; remove it, or name another with --out") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from None
    return len(rows)
