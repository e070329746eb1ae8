"""Joins the fleet's record and those of single hosts into one run.

A host's own record (`services.recorder --of`) has what its services said though the network to the
fleet's recorder was cut. Its times are brought to the clock of the fleet's record, and what that
one already has is left out: the same bytes on the same key at about the same time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from shared.bus import topics
from shared.exceptions import RunError
from shared.mcap_log.writer import COUNTS, RunWriter
from tools.runs.host_clocks import HostClocks
from tools.runs.run_index import RunIndex
from tools.runs.run_log import PART_S, RunLog, RunPart, clocks_of, parts_of

_OF_A_FILE: Final = ("clock", "split", COUNTS, "recovered")
"""Metadata that says something of a file, not of the run."""
_CHUNK_KIB: Final = 256
_NS: Final = 1e-9
_MARGIN_NS: Final = 1_000_000_000
"""A message lies so close to where the other record has it."""

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
            rows, near = [], dict[str, set[bytes]]()
            for key in log.keys():  # noqa: SIM118 - no dict
                raw = log.raw(key)
                near[key] = {payload for _, payload, _ in raw}
                rows += [(key, payload, t_ns) for t_ns, payload, _ in raw if log.holds(t_ns)]
            for record in records:
                for row in _rows_within(record, log):
                    if row[1] not in near.get(row[0], ()):
                        gained[row[0]] = gained.get(row[0], 0) + 1
                        rows.append(row)
            rows.sort(key=lambda row: row[2])
            writer.take_from(_Rows(rows), len(rows))
            progress((log.end_ns - log.began_ns()) * _NS / max(fleets.length_s, 1e-9))
    return gained


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
