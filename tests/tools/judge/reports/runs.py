"""Logs for the tests of the report: one run in virtual time, changed copies of it, and its page."""

from __future__ import annotations

import contextlib
import copy
import fnmatch
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import numpy as np

from shared.arrays import Array
from shared.bus import topics
from shared.clock import NS_PER_S
from tests.shared.mcap_log.runs import Queue, writer_like
from tools import cli
from tools.judge.reports.run_data import RunData
from tools.logs.run_log import RunLog, Series, read_run

SIM = (
    "sim --duration 4 --kill planner@1 --restart planner@1.8 --push 0.5:0.2:20,0,0 "
    "--fault hip_left:link_lost@3.2:0.4"
)


class Made(NamedTuple):
    """A run, and the output of the command that made it."""

    path: Path
    printed: str


def make(directory: Path) -> None:
    """Make the run of these tests; what the command said is in `printed.txt` beside it."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert cli.main([*SIM.split(), "--out", str(directory)]) == 0
    (directory / "printed.txt").write_text(printed.getvalue(), encoding="utf-8")


Change = Callable[[float, dict[str, Any]], object]
"""Takes the scenario time of a message, s, and the message; False leaves it out."""


def changed(
    log: RunLog,
    changes: Mapping[str, Change] = MappingProxyType({}),
    *,
    keep: Callable[[str], bool] = lambda _: True,
    attachments: Mapping[str, bytes] | None = None,
    about: Mapping[str, str] | None = None,
    more: Sequence[tuple[int, str, bytes]] = (),
) -> RunLog:
    """Return a copy of a log whose messages are changed by the patterns of their keys.

    `more` holds further messages: time, name of the key below the robot, payload.
    """
    zero_ns, prefix = RunData(log).zero_ns, f"xrl/{log.robot}/"
    found = copy.copy(log)
    found._series = {
        key: series for key, series in log._series.items() if keep(key.removeprefix(prefix))
    }
    for key, series in found._series.items():
        for pattern, change in changes.items():
            if fnmatch.fnmatch(key.removeprefix(prefix), pattern):
                rows = zip(series.received_ns, series.payloads, strict=True)
                found._series[key] = _series(_changed(rows, change, zero_ns))
    for t_ns, name, body in more:
        old = found._series.get(prefix + name, Series())
        rows = zip(old.received_ns, old.payloads, strict=True)
        found._series[prefix + name] = _series(sorted([*rows, (t_ns, body)]))
    found.attachments = log.attachments if attachments is None else dict(attachments)
    found.metadata = log.metadata if about is None else log.metadata | {"run": dict(about)}
    return found


def _changed(
    rows: Iterable[tuple[int, bytes]], change: Change, zero_ns: int
) -> Iterator[tuple[int, bytes]]:
    for received_ns, payload in rows:
        message = msgspec.json.decode(payload)
        if change((message["t_ns"] - zero_ns) / NS_PER_S, message) is not False:
            yield received_ns, msgspec.json.encode(message)


def _series(rows: Iterable[tuple[int, bytes]]) -> Series:
    found = Series()
    for received_ns, payload in rows:
        found.received_ns.append(received_ns)
        found.payloads.append(payload)
        found.seq.append(msgspec.json.decode(payload)["seq"])
    return found


def written(log: RunLog, directory: Path, *, repeats: int = 1) -> RunLog:
    """Write a log, or several times after each other, as a recorder does; and read it."""
    known = topics.all_keys(log.robot)
    rows = sorted((t, key, body) for key in log.keys() for t, body, _ in log.raw(key))  # noqa: SIM118
    length_ns = rows[-1][0] - rows[0][0] + NS_PER_S // 1000
    with writer_like(log, directory) as run:
        for number in range(repeats):
            moved = (_moved(row, known, number, length_ns) for row in rows)
            run.take_from(Queue(moved), len(rows))
    return read_run(run.path)


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


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert found is not None
    return json.loads(found[1])


def panel(data: dict[str, Any], title: str) -> dict[str, Any]:
    return next(panel for panel in data["panels"] if panel["title"] == title)


def line(data: dict[str, Any], title: str, label: str) -> tuple[Array, Array]:
    """Return times and values of a line; NaN where it breaks."""
    found = next(line for line in panel(data, title)["lines"] if line["label"] == label)
    return np.array(found["t"]), np.array(found["v"], dtype=np.float64)
