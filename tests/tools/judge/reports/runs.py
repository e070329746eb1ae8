"""Logs for the tests of the report: one run in virtual time, changed copies of it, and its page."""

from __future__ import annotations

import base64
import contextlib
import fnmatch
import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared.bus import topics
from shared.clock import NS_PER_S
from shared.mcap_log.writer import RunWriter
from tests.shared.mcap_log.runs import Queue
from tools import cli
from tools.judge.reports.run_data import RunData
from tools.logs.run_log import RunLog, read_run

SIM = (
    "sim --duration 4 --kill planner@1 --restart planner@1.8 --push 0.5:0.2:20,0,0 "
    "--fault hip_left:link_lost@3.2:0.4"
)
FROM_RECORDER = ("clock", "split", "counts")
"""Metadata written by the recorder itself."""


class Made(NamedTuple):
    """A run, and the output of the command that made it."""

    path: Path
    printed: str


def make(directory: Path) -> Made:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert cli.main([*SIM.split(), "--out", str(directory)]) == 0
    return Made(directory / "run.mcap", printed.getvalue())


def rewritten(
    log: RunLog,
    directory: Path,
    *,
    keep: Callable[[str], bool] = lambda _: True,
    attachments: Mapping[str, bytes] | None = None,
    about: Mapping[str, str] | None = None,
    payload: Callable[[str, bytes], bytes] = lambda _, payload: payload,
    more: Sequence[tuple[int, str, bytes]] = (),
    repeats: int = 1,
) -> RunLog:
    """Write a copy of a log with other topics, attachments or payloads, and read it.

    `more` holds further messages: time, name of the key below the robot, payload.
    """
    known = {key: topic for key, topic in topics.all_keys(log.robot).items() if topic.recorded}
    prefix = f"xrl/{log.robot}/"
    rows = []
    for key in known:
        name = key.removeprefix(prefix)
        if keep(name):
            rows += [(t, key, payload(name, body)) for t, body, _ in log.raw(key)]
    rows += [(t, prefix + name, body) for t, name, body in more]
    rows.sort(key=lambda row: row[0])
    length_ns = rows[-1][0] - rows[0][0] + NS_PER_S // 1000
    metadata = {name: row for name, row in log.metadata.items() if name not in FROM_RECORDER}
    if about is not None:
        metadata["run"] = dict(about)
    writer = RunWriter(
        directory,
        known,
        offset_ns=log.offset_ns,
        metadata=metadata,
        attachments=log.attachments if attachments is None else attachments,
        chunk_kib=64,
    )
    with writer as run:
        for number in range(repeats):
            moved = (_moved(row, known, number, length_ns) for row in rows)
            run.take_from(Queue(moved), len(rows))
    return read_run(run.path)


def changed(
    log: RunLog,
    directory: Path,
    name: str,
    change: Callable[[float, dict[str, Any]], object],
    **more: Any,
) -> RunLog:
    """Write a copy of a log in which the messages of some keys, by pattern, are changed in place.

    `change` takes the scenario time of a message, s, and the message.
    """
    zero_ns = RunData(log).zero_ns

    def payload(key: str, body: bytes) -> bytes:
        if not fnmatch.fnmatch(key, name):
            return body
        message = msgspec.json.decode(body)
        change((message["t_ns"] - zero_ns) / NS_PER_S, message)
        return msgspec.json.encode(message)

    return rewritten(log, directory, payload=payload, **more)


def _moved(
    row: tuple[int, str, bytes], known: Mapping[str, topics.Topic], number: int, length_ns: int
) -> tuple[str, bytes, int]:
    t_ns, key, body = row
    if not number:
        return key, body, t_ns
    by = number * length_ns
    message = msgspec.json.decode(body, type=known[key].type)
    changes: dict[str, object] = {"t_ns": message.t_ns + by}
    if hasattr(message, "scenario_s"):
        changes["scenario_s"] = message.scenario_s + by / NS_PER_S
    return key, msgspec.json.encode(msgspec.structs.replace(message, **changes)), t_ns + by


Array = NDArray[np.float64]


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert found is not None
    return json.loads(found[1])


def panel(data: dict[str, Any], title: str) -> dict[str, Any]:
    return next(panel for panel in data["panels"] if panel["title"] == title)


def decode_signal(signal: dict[str, Any], grid: dict[str, float]) -> tuple[Array, Array]:
    """Return times and values as the page's script decodes them; NaN where the line breaks."""
    codes = np.frombuffer(base64.b64decode(signal["d"]), "<i2").astype(np.int64)
    assert signal["first"] + len(codes) <= grid["count"]
    t = grid["begin"] + (signal["first"] + np.arange(len(codes)) + 0.5) * grid["step"]
    values = signal["lo"] + (codes + 32766) * signal["step"]
    values[codes == -32767] = np.nan
    present = codes != -32768
    return t[present], values[present]


def line(data: dict[str, Any], title: str, label: str) -> tuple[Array, Array]:
    lines = panel(data, title)["lines"]
    index = next(line for line in lines if line["label"] == label)["signal"]
    return decode_signal(data["signals"][index], data["grid"])
