"""Joins the fleet's record and those of single hosts into one run.

A host's own record (`services.recorder --of`) has what its services said though the network to the
fleet's recorder was cut. Its times are brought to the clock of the fleet's record, and what that
one already has is left out: the same bytes on the same key at about the same time.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from shared.bus import topics
from shared.clock import NS_PER_S
from shared.exceptions import RunError
from shared.mcap_log.writer import COUNTS, MessageHead, RunWriter
from tools.logs.host_clocks import ClockLife
from tools.logs.run_index import RunIndex
from tools.logs.run_log import PART_S, RunLog, RunPart, clocks_of, parts_of

_OF_A_FILE: Final = ("clock", "split", COUNTS, "recovered")
"""Metadata that says something of a file, not of the run."""
_CHUNK_KIB: Final = 256
_NS: Final = 1e-9
_MARGIN_NS: Final = NS_PER_S
"""How far the joined run may begin before the fleet's record, and end after it."""
LATE_S: Final = 10.0
"""Longest delay of a message to the fleet's recorder: a cut network holds some up."""

Timed = tuple[int, bytes]
"""When the fleet's recorder had a message or would have, and its payload."""
Row = tuple[str, bytes, int]
"""Key, payload, and when the fleet's recorder had it or would have."""


class HostRecord(NamedTuple):
    """One host's own record, beside the fleet's."""

    run: RunIndex
    host: str
    """As the fleet's robot file names it."""
    clock: ClockLife | None
    """The host's clock against that of the fleet's recorder; None: it is one clock."""

    def to_fleets_ns(self, own_ns: int) -> int:
        """Return a time of this record on the clock of the fleet's."""
        if self.clock is None:
            return own_ns
        about_ns = own_ns + round(self.clock.points[0].bounds.best_ns)
        return own_ns + round(self.clock.offset_ns(about_ns))

    def to_own_ns(self, fleets_ns: int) -> int:
        """Return a time of the fleet's record on the clock of this one."""
        return fleets_ns - (0 if self.clock is None else round(self.clock.offset_ns(fleets_ns)))

    def overlap_ns(self, fleets: RunIndex) -> int:
        """Return how long both were recorded; below zero: how far they are apart."""
        first_ns, last_ns = map(self.to_fleets_ns, self.run.span_ns)
        began_ns, ended_ns = fleets.span_ns
        return min(last_ns, ended_ns) - max(first_ns, began_ns)


def host_record(fleets: RunIndex, index: RunIndex) -> HostRecord:
    """Return how a record joins the fleet's.

    Refuses a record that no host wrote, of another robot, of another time or of an unknown clock.
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
    for one in (fleets, index):
        if not one.length_s:
            raise RunError(f"{one.path}: has no messages; nothing can be joined")
    hosts = {fleets.hosts.get(name, "") for name in services}
    if len(hosts) != 1:
        names = ", ".join(services)
        raise RunError(f"{index.path}: {names} run on {len(hosts)} hosts; one is right")
    (host,) = hosts
    clocks = clocks_of(fleets)
    lives = (None,) if clocks is None else clocks.lives.get(host, ())
    if not lives:
        raise RunError(
            f"{fleets.path}: has nothing of {host}, so that host's clock is not known there"
        )
    found = max(
        (HostRecord(index, host, life) for life in lives), key=lambda one: one.overlap_ns(fleets)
    )
    if found.overlap_ns(fleets) < 0:
        apart_s = -found.overlap_ns(fleets) * _NS
        raise RunError(f"{index.path}: of another time than {fleets.path}, {apart_s:.0f} s apart")
    return found


def join(
    fleets: RunIndex,
    records: Sequence[HostRecord],
    out: Path,
    progress: Callable[[float], None] = lambda _done: None,
) -> dict[str, int]:
    """Write the joined run into a folder that holds no run; return what each key gained.

    `progress` takes the fraction that is done. What was written is gone after an error (RunError).
    """
    gained: dict[str, int] = {}
    metadata = {name: row for name, row in fleets.metadata.items() if name not in _OF_A_FILE}
    paths: dict[str, list[str]] = {}
    for record in records:
        paths.setdefault(record.host, []).append(str(record.run.path))
    metadata["joined"] = {host: ", ".join(those) for host, those in paths.items()}
    aside = out / ".join.part"
    shutil.rmtree(aside, ignore_errors=True)
    writer = RunWriter(
        aside,
        topics.all_keys(fleets.robot),
        offset_ns=fleets.offset_ns,
        metadata=metadata,
        attachments=fleets.attachments,
        chunk_kib=_CHUNK_KIB,
    )
    try:
        _join(writer, fleets, records, gained, progress)
        writer.path.replace(out / writer.path.name)
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    return gained


def _join(
    writer: RunWriter,
    fleets: RunIndex,
    records: Sequence[HostRecord],
    gained: dict[str, int],
    progress: Callable[[float], None],
) -> None:
    with writer:
        for log in parts_of(fleets, part_s=PART_S, margin_s=2.0 * LATE_S, as_sent=True):
            window = _window_ns(fleets, log)
            new = _gained(log, records, window)
            rows: list[Row] = []
            for key in {*log.keys(), *new}:
                own = [(t_ns, payload) for t_ns, payload, _ in log.raw(key)]
                for t_ns, payload, is_new in in_order(own, new.get(key, ())):
                    if window[0] <= t_ns < window[1]:
                        rows.append((key, payload, t_ns))
                        if is_new:
                            gained[key] = gained.get(key, 0) + 1
            rows.sort(key=lambda row: row[2])
            writer.take_from(_Rows(rows), len(rows))
            progress((log.end_ns - log.began_ns()) * _NS / max(fleets.length_s, 1e-9))


def in_order(own: Sequence[Timed], new: Sequence[Timed]) -> list[tuple[int, bytes, bool]]:
    """Return the messages of one key in the order in which they were sent, True: it is new.

    A message that the fleet's recorder had keeps its time there, however late it came; one that it
    gains is put between its neighbours.
    """
    rows = [(t_ns, payload, False) for t_ns, payload in own]
    if not new:
        return rows
    rows += [(t_ns, payload, True) for t_ns, payload in new]
    sent = _sent_ns([payload for _, payload, _ in rows], len(own))
    if sent is None:
        return sorted(rows, key=lambda row: row[0])
    order = sorted(range(len(rows)), key=lambda n: sent[n])
    times = [rows[n][0] for n in order]
    for place in range(1, len(order)):
        if rows[order[place]][2]:
            times[place] = max(times[place], times[place - 1])
    for place in range(len(order) - 2, -1, -1):
        if rows[order[place]][2]:
            times[place] = min(times[place], times[place + 1])
    return [(t_ns, *rows[n][1:]) for t_ns, n in zip(times, order, strict=True)]


def _sent_ns(payloads: Sequence[bytes], count: int) -> list[tuple[int, int]] | None:
    """Return each message's own time and number; None if they tell no order.

    The first `count` were recorded in their order: in that their times go back only if the sender's
    host started again, or has had no sample of its drive yet.
    """
    decode = msgspec.json.Decoder(MessageHead).decode
    try:
        found = [(head.t_ns, head.seq) for head in map(decode, payloads)]
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None
    goes_back = any(after[0] < before[0] for before, after in pairwise(found[:count]))
    return None if goes_back else found


def _window_ns(fleets: RunIndex, log: RunLog) -> tuple[int, int]:
    """Return from when to when, fleet's clock, the joined run has the messages of a part."""
    began_ns, ended_ns = fleets.span_ns
    return (
        began_ns - _MARGIN_NS if log.is_first else log.begin_ns,
        ended_ns + _MARGIN_NS if log.is_last else log.end_ns,
    )


def _gained(
    log: RunLog, records: Sequence[HostRecord], window: tuple[int, int]
) -> dict[str, list[Timed]]:
    """Return by key what hosts' records have around a part, and the fleet's has not."""
    found: dict[str, list[Timed]] = {}
    known: dict[str, set[bytes]] = {}
    for record in records:
        for key, payload, at_ns in _rows_around(record, window):
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


def _rows_around(record: HostRecord, window: tuple[int, int]) -> Iterator[Row]:
    """Yield the messages of a host's record in a window and a margin about it, fleet's clock."""
    own_ns = record.run.span_ns[0]
    begin_s, end_s = ((record.to_own_ns(t_ns) - own_ns) * _NS for t_ns in window)
    if end_s + LATE_S < 0.0 or begin_s - LATE_S > record.run.length_s:
        return
    own = RunLog(record.run, RunPart(max(0.0, begin_s - LATE_S), end_s + LATE_S), as_sent=True)
    for key in own.keys():  # noqa: SIM118 - no dict
        for t_ns, payload, _ in own.raw(key):
            yield key, payload, record.to_fleets_ns(t_ns)
