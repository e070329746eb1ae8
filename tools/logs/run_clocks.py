"""Finds the clocks of a run's hosts: where to look in it, and what is seen there.

A record of an hour is not read for that: a chunk now and then tells when a host restarted,
and a few seconds where each clock is first and last heard tell how it stands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

from shared.bus import topics
from shared.bus.topics import RECORDER
from shared.clock import NS_PER_S
from tools.logs.clock_offsets import UNKNOWN, OffsetBounds
from tools.logs.host_clocks import (
    ClockLife,
    ClockPoint,
    HostClocks,
    Messages,
    bounds_in,
    spans_of_lives,
)
from tools.logs.run_index import RunIndex
from tools.topic_keys import sender_of

LOOK_NS: Final = 5 * NS_PER_S
"""Length of the part in which the hosts' clocks are compared."""
DRIFT_NS: Final = 60 * NS_PER_S
"""Where a host is heard for longer they are compared a second time, at its end."""
LOOKS_MAX: Final = 16
SAMPLE_NS: Final = 10 * NS_PER_S
"""Time between two looks for a restart of a host."""
SAMPLES_MAX: Final = 400


def find_clocks(index: RunIndex, read: Callable[[float, float], Messages]) -> HostClocks | None:
    """Compare the clocks of a run's hosts; None if all its services ran on one.

    `read` gives a part with all times as they were sent, from and to s since its first message.
    """
    hosts = index.hosts
    if RECORDER not in hosts or len(set(hosts.values())) == 1:
        return None
    lives: dict[str, list[ClockLife]] = {host: [] for host in hosts.values()}
    seen: dict[int, dict[str, OffsetBounds]] = {}
    for host, samples in _samples_of_hosts(index, hosts).items():
        for first_ns, last_ns in spans_of_lives(samples):
            points = []
            for at_ns in _looks_in(first_ns, last_ns):
                if at_ns not in seen and len(seen) < LOOKS_MAX:
                    edges = (at_ns - LOOK_NS // 2, at_ns + LOOK_NS // 2)
                    part = read(*((t_ns - index.began_ns) / NS_PER_S for t_ns in edges))
                    seen[at_ns] = bounds_in(part, hosts)
                bounds = seen.get(at_ns, {}).get(host, UNKNOWN)
                if math.isfinite(bounds.best_ns):
                    points.append(ClockPoint(at_ns - index.offset_ns, bounds))
            if points:
                lives[host].append(ClockLife(tuple(points)))
    return HostClocks(hosts, {host: tuple(found) for host, found in lives.items()})


def _samples_of_hosts(
    index: RunIndex, hosts: Mapping[str, str]
) -> dict[str, list[tuple[int, int]]]:
    """Return for each host, now and then, the smallest of reception less sender's time, ns."""
    known = topics.all_keys(index.robot).items()
    of_key = {
        key: hosts.get(sender_of(topic, key.split("/")[3] if topic.per_module else ""), "")
        for key, topic in known
    }
    step_ns = max(SAMPLE_NS, (index.ended_ns - index.began_ns) // SAMPLES_MAX + 1)
    found: dict[str, list[tuple[int, int]]] = {host: [] for host in hosts.values()}
    for at_ns in [*range(index.began_ns, index.ended_ns, step_ns), index.ended_ns]:
        smallest: dict[str, int] = {}
        for record, keys in index.records(at_ns, at_ns + 1):
            for row in record.rows:
                host = of_key.get(keys.get(row.channel_id, ""), "")
                if host and abs(row.log_ns - at_ns) < NS_PER_S:
                    late_ns = row.log_ns - row.publish_ns
                    smallest[host] = min(smallest.get(host, late_ns), late_ns)
        for host, late_ns in smallest.items():
            found[host].append((at_ns, late_ns))
    return found


def _looks_in(first_ns: int, last_ns: int) -> tuple[int, ...]:
    """Return where to look closely in the life of a clock, log time: at its begin and its end."""
    if last_ns - first_ns < DRIFT_NS:
        return (first_ns + min(LOOK_NS // 2, (last_ns - first_ns) // 2),)
    return first_ns + LOOK_NS // 2, last_ns - LOOK_NS // 2
