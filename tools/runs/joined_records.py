"""Joins the fleet's record and those of single hosts into one run.

A host's own record (`services.recorder --of`) has what its services said though the network to the
fleet's recorder was cut. Its times are brought to the clock of the fleet's record, and what that
one already has is left out: the same bytes on the same key at about the same time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from shared.bus import topics
from shared.exceptions import RunError
from shared.mcap_log.writer import COUNTS, MessageHead, RunWriter
from tools.runs.host_clocks import HostClocks
from tools.runs.run_index import RunIndex
from tools.runs.run_log import PART_S, RunLog, RunPart, clocks_of, parts_of

_OF_A_FILE: Final = ("clock", "split", COUNTS, "recovered")
"""Metadata that says something of a file, not of the run."""
_CHUNK_KIB: Final = 256
_NS: Final = 1e-9
_MARGIN_NS: Final = 1_000_000_000
"""A message lies so close to where the other record has it."""

Timed = tuple[int, bytes]
"""When the fleet's recorder had a message or would have, and its payload."""
Row = tuple[str, bytes, int]
"""Key, payload, and when the fleet's recorder had it or would have."""


class HostRecord(NamedTuple):
    """One host's own record, beside the fleet's."""

    run: RunIndex
    host: str
    """As the fleet's robot file names it."""
    clocks: HostClocks | None
    """Of the fleet's record; None: it ran on one host."""

    def to_fleets_ns(self, own_ns: int) -> int:
        """Return a time of this record on the clock of the fleet's."""
        if self.clocks is None:
            return own_ns
        about_ns = own_ns + self.clocks.offset_of_ns(self.host, own_ns)
        return own_ns + self.clocks.offset_of_ns(self.host, about_ns)


def host_record(fleets: RunIndex, index: RunIndex) -> HostRecord:
    """Return how a record joins the fleet's.

    Raises:
        RunError: it is no host's own, another robot's, of another time, or its clock is not known.
    """
    if fleets.metadata["run"].get("of"):
        raise RunError(f"{fleets.path}: is a host's own record; the fleet's comes first")
    services = [name for name in index.metadata["run"].get("of", "").split(",") if name]
    if not services:
        raise RunError(
            f"{index.path}: is no host's own record; one of `xrl up --only ...,host_recorder` is "
            "right, and the fleet's comes first"
        )
    if index.robot != fleets.robot:
        raise RunError(f"{index.path}: of the robot {index.robot}; {fleets.path}: {fleets.robot}")
    clocks = clocks_of(fleets)
    hosts = {fleets.hosts.get(name, "") for name in services}
    if len(hosts) != 1:
        raise RunError(
            f"{index.path}: {', '.join(services)} run on {len(hosts)} hosts; one is right"
        )
    (host,) = hosts
    if clocks is not None and not clocks.knows(host):
        raise RunError(
            f"{fleets.path}: has nothing of {host} where it begins or ends, so that host's clock "
            "is not known; join a longer record"
        )
    found = HostRecord(index, host, clocks)
    first_ns, last_ns = (
        found.to_fleets_ns(wall_ns - index.offset_ns) + fleets.offset_ns
        for wall_ns in (index.began_ns, index.ended_ns)
    )
    if last_ns < fleets.began_ns or first_ns > fleets.ended_ns:
        apart_s = max(fleets.began_ns - last_ns, first_ns - fleets.ended_ns) * _NS
        raise RunError(f"{index.path}: of another time than {fleets.path}, {apart_s:.0f} s apart")
    return found


def join(
    fleets: RunIndex,
    records: Sequence[HostRecord],
    out: Path,
    progress: Callable[[float], None] = lambda _done: None,
) -> dict[str, int]:
    """Write the joined run into a folder.

    Args:
        fleets: the fleet's record.
        records: of single hosts.
        out: folder that holds no run.
        progress: takes the fraction that is done.

    Returns:
        How many messages each key gained.

    Raises:
        RunError: a file cannot be read or written.
    """
    gained: dict[str, int] = {}
    metadata = {name: row for name, row in fleets.metadata.items() if name not in _OF_A_FILE}
    metadata["joined"] = {record.host: str(record.run.path) for record in records}
    writer = RunWriter(
        out,
        topics.all_keys(fleets.robot),
        offset_ns=fleets.offset_ns,
        metadata=metadata,
        attachments=fleets.attachments,
        chunk_kib=_CHUNK_KIB,
    )
    with writer:
        for log in parts_of(fleets, part_s=PART_S, as_sent=True):
            rows: list[Row] = []
            gained_by_key = _gained(log, records)
            for key in {*log.keys(), *gained_by_key}:
                own = [(t_ns, payload) for t_ns, payload, _ in log.raw(key) if log.holds(t_ns)]
                new = gained_by_key.get(key, [])
                if new:
                    gained[key] = gained.get(key, 0) + len(new)
                rows += [(key, payload, t_ns) for t_ns, payload in in_order(own, new)]
            rows.sort(key=lambda row: row[2])
            writer.take_from(_Rows(rows), len(rows))
            progress((log.end_ns - log.began_ns()) * _NS / max(fleets.length_s, 1e-9))
    return gained


def in_order(own: Sequence[Timed], gained: Sequence[Timed]) -> list[Timed]:
    """Return the messages of one key in the order in which they were sent.

    A message that the fleet's recorder had keeps its time there, however late it came; one that it
    gains is put between its neighbours.

    Args:
        own: of the fleet's record, in its order.
        gained: of a host's record.
    """
    if not gained:
        return list(own)
    heads = msgspec.json.Decoder(MessageHead).decode
    rows = [(heads(payload), t_ns, payload, False) for t_ns, payload in own]
    rows += [(heads(payload), t_ns, payload, True) for t_ns, payload in gained]
    rows.sort(key=lambda row: (row[0].t_ns, row[0].seq))
    times = [t_ns for _, t_ns, _, _ in rows]
    for numbers, bound in ((range(1, len(rows)), max), (range(len(rows) - 2, -1, -1), min)):
        for n in numbers:
            if rows[n][3]:
                times[n] = bound(times[n], times[n - 1 if bound is max else n + 1])
    return [(t_ns, row[2]) for t_ns, row in zip(times, rows, strict=True)]


def _gained(log: RunLog, records: Sequence[HostRecord]) -> dict[str, list[Timed]]:
    """Return by key what hosts' records have in a part, and the fleet's has not."""
    found: dict[str, list[Timed]] = {}
    known: dict[str, set[bytes]] = {}
    for record in records:
        for key, payload, at_ns in _rows_within(record, log):
            if key not in known:
                known[key] = {one for _, one, _ in log.raw(key)}
            if payload not in known[key]:
                known[key].add(payload)
                found.setdefault(key, []).append((at_ns, payload))
    return found


class _Rows:
    """A source of messages for the writer."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self._rows = iter(rows)

    def take(self) -> Row | None:
        return next(self._rows, None)


def _rows_within(record: HostRecord, log: RunLog) -> Iterator[Row]:
    """Yield the messages of a host's record in a part of the fleet's, on the fleet's clock."""
    index = record.run
    own_ns = index.began_ns - index.offset_ns
    ahead_ns = record.to_fleets_ns(own_ns) - own_ns
    began_ns = own_ns + ahead_ns
    begin_s = 0.0 if log.is_first else (log.begin_ns - _MARGIN_NS - began_ns) * _NS
    end_s = index.length_s if log.is_last else (log.end_ns + _MARGIN_NS - began_ns) * _NS
    if end_s < 0.0 or begin_s > index.length_s:
        return
    part = RunPart(max(0.0, begin_s), end_s + 1.0)
    own = RunLog(index, part, as_sent=True)
    for key in own.keys():  # noqa: SIM118 - no dict
        for t_ns, payload, _ in own.raw(key):
            at_ns = record.to_fleets_ns(t_ns)
            if log.holds(at_ns):
                yield key, payload, at_ns
