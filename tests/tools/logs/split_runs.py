"""A run that was split while it was recorded, for tests."""

from __future__ import annotations

from pathlib import Path

from shared.bus import topics
from shared.mcap_log.writer import RunWriter
from tests.shared.mcap_log.runs import Queue
from tools.logs.run_log import RunLog

PARTS = 3


def recorded_in_parts(whole: RunLog, folder: Path) -> Path:
    """Record the messages of a run once more, in three files; return their folder."""
    rows = sorted(
        (received_ns, key, payload)
        for key in whole.keys()  # noqa: SIM118 - a log is no mapping
        for received_ns, payload, _ in whole.raw(key)
    )
    keys = {k: topic for k, topic in topics.all_keys(whole.robot).items() if topic.recorded}
    about = {name: whole.metadata[name] for name in ("run", "packages")}
    length = len(rows) // PARTS
    with RunWriter(
        folder, keys, offset_ns=0, metadata=about, attachments=whole.attachments, chunk_kib=64
    ) as writer:
        for number in range(PARTS):
            if number:
                writer.finish()
                writer.begin()
            part = rows[number * length : None if number == PARTS - 1 else (number + 1) * length]
            writer.take_from(Queue((key, data, at) for at, key, data in part), len(part))
    assert len(list(folder.glob("*.mcap"))) == PARTS
    return folder
