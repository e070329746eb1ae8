"""A run as CSV tables: one per key with all of its messages, or one on a time grid.

A column is a field, or an element of a field: `tau_ff[1]`, as in viewers of the log. In a table of
one key, `time_s` is the sender's stamp on the report's time axis (`stamped`).
"""

from __future__ import annotations

import contextlib
import csv
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter, itemgetter
from pathlib import Path
from typing import Any, Final, TypeAlias, get_args, get_origin

import msgspec

from shared.bus import topics
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.exceptions import RunError
from tools.judge.run_parts import zero_ns
from tools.logs.run_index import RunIndex
from tools.logs.run_log import SEE_INFO, NewestAt, RunLog, RunPart, parts_of
from tools.topic_keys import TopicKey

_CLOCK_NS: Final = NS_PER_S
"""Maximum difference, ns, between a stamp and its reception on one clock."""
TIME: Final = "time_s"
GRID_NAME: Final = "run.csv"
"""File name of the table on a grid."""
HELD_S: Final = 0.5
"""Maximum age of the newest message, s; the cells of a grid stay empty if it is older."""

_HEAD: Final = ("t_ns", "seq")
"""Fields of the first columns."""
FOR_REEXECUTION: Final = (topics.JOINT_TRACE, topics.PLANNER_CHECKPOINT, topics.SIM_STATE)

_OF_OTHER_TABLES: Final = "commands"
"""Field of `PlannerStatus` whose elements are the rows of the tables `joint.*.command`."""

Columns = Mapping[str, Sequence[Any]]
"""Values by name, all of the same length; None for an empty cell."""


Reader: TypeAlias = Callable[[Any], Any]
"""Returns a column's value in a message: an int, a float, a bool or a str."""


class _CsvFile:
    """A CSV file that is being written."""

    def __init__(self, path: Path, columns: Iterable[str]) -> None:
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)
        self._writer.writerow(columns)

    def add(self, columns: Columns) -> None:
        self._writer.writerows(zip(*columns.values(), strict=True))

    def close(self) -> None:
        self._file.close()


def stamped(
    log: RunLog, topic: Topic, module: str, *, margins: bool = False
) -> Iterator[tuple[int, Any]]:
    """Yield each message of a key with its time, ns on the recorder's monotonic clock.

    The time is the sender's stamp. If the stamp is more than a second from the time of reception,
    because the sender is on another host or had no stamp yet, the time is that of reception, up to
    40 ms late. With `margins`, messages before and after the part are included.
    """
    received = log.received_ns(topic, module)
    for at_ns, message in zip(received, log.messages(topic, module), strict=True):
        if margins or log.holds(at_ns):
            alike = abs(at_ns - message.t_ns) <= _CLOCK_NS
            yield (message.t_ns if alike else at_ns), message


def columns_of(kind: type[msgspec.Struct]) -> dict[str, Reader]:
    """Return the columns of a message type, by name."""
    found: dict[str, Reader] = {}
    fields = msgspec.structs.fields(kind)
    for field in sorted(fields, key=lambda field: field.name not in _HEAD):
        if field.name == _OF_OTHER_TABLES:
            continue
        _add_column(found, field.name, field.type, attrgetter(field.name))
    return found


def write_tables(
    index: RunIndex,
    part: RunPart,
    keys: Sequence[TopicKey],
    folder: Path,
    done: Callable[[float], None],
) -> dict[str, int]:
    """Write a file for each key with messages; return the number of rows of each file.

    `done` receives the time of the run that has been written, s.
    """
    zero = zero_ns(index)
    open_files: dict[str, _CsvFile] = {}
    rows: dict[str, int] = {}
    readers = {key.topic: columns_of(key.topic.type) for key in keys}
    with contextlib.ExitStack() as stack:
        for log in parts_of(index, part, done=done):
            for key in keys:
                held = list(stamped(log, *key))
                if not held:
                    continue
                getters = readers[key.topic]
                name = key.name.replace("/", ".")
                if name not in open_files:
                    file = _CsvFile(folder / f"{name}.csv", (TIME, *getters))
                    open_files[name] = stack.enter_context(contextlib.closing(file))
                times = [(at_ns - zero) / NS_PER_S for at_ns, _ in held]
                cells = {
                    column: [read(message) for _, message in held]
                    for column, read in getters.items()
                }
                open_files[name].add({TIME: times, **cells})
                rows[name] = rows.get(name, 0) + len(held)
    return rows


def write_grid(
    index: RunIndex,
    part: RunPart,
    keys: Sequence[TopicKey],
    rate_hz: float,
    path: Path,
    done: Callable[[float], None],
) -> int:
    """Write one table on a time grid, with the newest message of each key at each time.

    Topics of events, which have no rate, are left out. `done` is as for `write_tables`. Returns the
    number of rows.
    """
    steady = [key for key in keys if key.topic.rate_hz]
    if not steady:
        raise RunError("--rate: none of these topics has a rate; remove --rate to export events")
    readers = {key.topic: columns_of(key.topic.type) for key in steady}
    names = [f"{key.name}.{name}" for key in steady for name in readers[key.topic]]
    zero, step_ns, count, heard = zero_ns(index), NS_PER_S / rate_hz, 0, False
    with contextlib.closing(_CsvFile(path, (TIME, *names))) as file:
        for log in parts_of(index, part, done=done):
            first = math.ceil((log.begin_ns - zero) / step_ns)
            last = math.ceil((log.end_ns - zero) / step_ns)
            grid = [zero + round(number * step_ns) for number in range(first, last)]
            cells: dict[str, Sequence[Any]] = {TIME: [(at - zero) / NS_PER_S for at in grid]}
            for key in steady:
                newest = _newest_at(log, key, grid)
                heard = heard or any(message is not None for message in newest)
                for name, read in readers[key.topic].items():
                    cells[f"{key.name}.{name}"] = [
                        None if message is None else read(message) for message in newest
                    ]
            if grid:
                file.add(cells)
            count += len(grid)
    if not heard:
        raise RunError(f"{index.path}: no message of these topics in this part; {SEE_INFO}")
    return count


def _newest_at(log: RunLog, key: TopicKey, grid: Iterable[int]) -> list[Any | None]:
    rows = sorted(stamped(log, *key, margins=True), key=itemgetter(0))
    newest = NewestAt(rows, [at_ns for at_ns, _ in rows])
    found: list[Any | None] = []
    for at_ns in grid:
        row: Any = newest.at(at_ns)
        fresh = row is not None and at_ns - row[0] <= HELD_S * NS_PER_S
        found.append(row[1] if fresh else None)
    return found


def _add_column(found: dict[str, Reader], name: str, kind: Any, read: Reader) -> None:
    """Add a field's column, or the columns of its elements; other values become JSON."""
    elements = get_args(kind)
    if kind in (int, float, bool, str):
        found[name] = read
    elif get_origin(kind) is tuple and elements[-1] is not Ellipsis:
        for number, element in enumerate(elements):
            _add_column(found, f"{name}[{number}]", element, _element(read, number))
    else:
        found[name] = lambda message: msgspec.json.encode(read(message)).decode()


def _element(read: Reader, number: int) -> Reader:
    return lambda message: read(message)[number]
