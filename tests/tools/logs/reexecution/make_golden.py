"""Makes a golden log: `python -m tests.tools.logs.reexecution.make_golden RUN.mcap OUT.mcap`.

RUN.mcap is `xrl sim --scenario stand --duration 1`. A second of it is kept, of the topics that
re-execution needs, with the traces of two modules; nothing of the machine but its processor.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer

from shared.bus import topics
from shared.clock import NS_PER_S
from shared.mcap_log import schema
from shared.mcap_log.writer import PROFILE
from tools.logs.run_log import RunLog, read_run

KEPT_FROM_S: Final = 2.3
TRACED: Final = ("knee_left", "hip_left")
TOPICS: Final = (
    topics.PLANNER_STATUS,
    topics.PLANNER_CHECKPOINT,
    topics.JOINT_STATE,
    topics.JOINT_EVENT,
    topics.WRENCH,
)
RUN_FACTS: Final = ("schema_version", "robot", "scenario", "lockstep", "cpu_model")


def shortened(log: RunLog) -> RunLog:
    """Leave out of a log what the golden one does not need."""
    begin_ns = log.began_ns() + round(KEPT_FROM_S * NS_PER_S)
    kept = {key for topic in TOPICS for key in topics.keys(topic, log.robot)}
    kept |= {topics.JOINT_TRACE.key(log.robot, module) for module in TRACED}
    for key, series in list(log._series.items()):
        rows = [row for row in log.raw(key) if row[0] >= begin_ns and key in kept]
        series.received_ns = [row[0] for row in rows]
        series.payloads = [row[1] for row in rows]
        series.seq = [row[2] for row in rows]
    log.metadata = {
        "run": {name: log.metadata["run"][name] for name in RUN_FACTS},
        "clock": log.metadata["clock"],
    }
    log.attachments.pop("model.xml", None)
    return log


def main() -> None:
    """Write it."""
    source, out = map(Path, sys.argv[1:])
    log = shortened(read_run(source))
    rows = [(t, key, data, seq) for key in log.keys() for t, data, seq in log.raw(key)]  # noqa: SIM118
    types = topics.all_keys(log.robot)
    with out.open("xb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile=PROFILE)
        for name, entries in log.metadata.items():
            writer.add_metadata(name, dict(entries))
        for name, content in log.attachments.items():
            writer.add_attachment(0, 0, name, "application/octet-stream", content)
        channels: dict[str, int] = {}
        for received_ns, key, data, seq in sorted(rows):
            if key not in channels:
                kind = types[key].type
                number = writer.register_schema(
                    schema.name_of(kind), schema.ENCODING, schema.encoded(kind)
                )
                channels[key] = writer.register_channel(key, MessageEncoding.JSON, number, {})
            t_ns = received_ns + log.offset_ns
            writer.add_message(channels[key], t_ns, data, t_ns, seq & 0xFFFFFFFF)
        writer.finish()


if __name__ == "__main__":
    main()
