"""What the recorder and the tools leave behind, for the tests of test_plotjuggler.py."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from shared.bus import codec
from shared.clock import NS_PER_S
from shared.mcap_log import recover
from tests.shared.mcap_log import runs
from tests.shared.mcap_log.runs import Queue, sample
from tools import cli
from tools.logs.run_log import RunLog, read_run

SIM = (
    "sim --scenario stand --duration 0.8 --kill planner@0.2 --restart planner@0.45 "
    "--push 0.1:0.1:20,0,0 --fault hip_left:link_lost@0.5:0.1 --fault hip_left:over_temperature@0.7"
)
RECENT_S = 0.9


def record(directory: Path) -> RunLog:
    """Make a run in virtual time: planner killed and back, a push, a hot drive."""
    with contextlib.redirect_stdout(io.StringIO()):
        assert cli.main([*SIM.split(), "--out", str(directory)]) in (0, 1)  # it may fall
    return read_run(directory / "run.mcap")


def make(log: RunLog, out: Path) -> dict[str, Path]:
    """Make of a run's last moments what can become of it; and a file with every topic in it."""
    rows = sorted((t, key, body) for key in log.keys() for t, body, _ in log.raw(key))  # noqa: SIM118
    since_ns = rows[-1][0] - round(RECENT_S * NS_PER_S)
    recent = [(key, body, t) for t, key, body in rows if t >= since_ns]
    with runs.writer_like(log, out / "whole") as run:
        run.take_from(Queue(recent), len(recent))
    cut = out / "cut.mcap"
    cut.write_bytes(run.path.read_bytes()[: run.path.stat().st_size * 2 // 3])
    recover.recover(cut, out / "recovered.mcap")
    return {
        "recorded": log.path,
        "whole": run.path,
        "cut": cut,
        "recovered": out / "recovered.mcap",
        "every": _every_topic(out / "every"),
    }


def write_one(
    path: Path, payloads: list[Any], *, encoding: str = "json", with_schema: bool = True
) -> Path:
    """Write a file of one channel, `a/b`, by the mcap package."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        number = writer.register_schema("x", "jsonschema", b"{}") if with_schema else 0
        channel = writer.register_channel("a/b", encoding, number)
        for t_ns, payload in enumerate(payloads):
            data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
            writer.add_message(channel, t_ns, data, t_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def _every_topic(directory: Path) -> Path:
    sent = [
        (key, codec.encode(sample(topic.type, seq=seq, t_ns=seq * 1_000_000)), seq * 1_000_000)
        for seq in range(3)
        for key, topic in runs.recorded_topics().items()
    ]
    return runs.write(directory, sent)
