"""The clocks of the hosts in a run: what brings the times of each service to the recorder's.

A message carries its sender's time, and a host's clock counts from its own start: the record of
several hosts holds several times, hours apart. What lies between them is found from the messages
themselves (`tools/logs/clock_offsets.py`), where a host is first heard and where it is last heard;
in between it changes evenly, for clocks drift. A host that starts again within the run has a second
clock from then on. What is not known is not guessed: such a message has the time at which the
recorder got it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple, Protocol

from shared.bus import topics
from shared.bus.topics import RECORDER, Topic
from shared.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from shared.config.robot_config import SERVICES
from shared.joints import MODULES
from tools.logs.clock_offsets import TIME_MAX_NS, ClockOffsets, OffsetBounds
from tools.topic_keys import sender_of

PLANNER: Final = "planner"
THIS_HOST: Final = "this host"
"""Name of the host of services whose endpoint is a socket in the file system."""
LATE_MAX_NS: Final = 60 * NS_PER_S
"""A message that seems to take longer is of a clock that is not known."""
JUMP_NS: Final = NS_PER_S
"""A clock whose offset changes by more than this from one sample to the next has restarted."""


class Messages(Protocol):
    """What is read of a run: a `tools.logs.run_log.RunLog` with times as they were sent."""

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        """Return the messages of a topic."""

    def received_ns(self, topic: Topic, module: str = "") -> list[int]:
        """Return when the recorder got each, on its own clock."""

    def holds(self, received_ns: int) -> bool:
        """Return True for a message of this part of the run."""


class ClockPoint(NamedTuple):
    """How a host's clock stood in a short part of the run."""

    at_ns: int
    """Middle of it, recorder's clock."""
    bounds: OffsetBounds


class ClockLife(NamedTuple):
    """A host's clock from one start of that host to the next."""

    points: tuple[ClockPoint, ...]
    """One or two, with a `best_ns` each."""

    def offset_ns(self, at_ns: int) -> float:
        """Return what brings its times to the recorder's clock, at a time of that one."""
        first, last = self.points[0], self.points[-1]
        begin, end = first.bounds.best_ns, last.bounds.best_ns
        if last.at_ns == first.at_ns:
            return begin
        return begin + (end - begin) * (at_ns - first.at_ns) / (last.at_ns - first.at_ns)


class HostClocks:
    """The clocks of all hosts of a run against its recorder's.

    Attributes:
        hosts: host of each service.
        lives: of each host's clock, in the order in which they were heard.
    """

    def __init__(
        self, hosts: Mapping[str, str], lives: Mapping[str, tuple[ClockLife, ...]]
    ) -> None:
        self.hosts, self.lives = hosts, lives

    def offset_ns(self, topic: Topic, module: str, t_ns: int, received_ns: int) -> int:
        """Return what brings a message's times to the recorder's clock."""
        late_ns = received_ns - t_ns
        if abs(late_ns) >= TIME_MAX_NS:
            return 0
        lives = self.lives.get(self.hosts.get(sender_of(topic, module), ""), ())
        offsets = [life.offset_ns(received_ns) for life in lives]
        nearest = min(offsets, key=lambda offset: abs(late_ns - offset), default=math.inf)
        return round(nearest) if abs(late_ns - nearest) < LATE_MAX_NS else late_ns

    def as_json(self) -> dict[str, Any]:
        """Return each host: services, and life by life its clock's offset and the error of that."""
        return {
            host: {
                "services": services_on(self.hosts, host),
                "clocks": [
                    {
                        "offset_s": life.points[0].bounds.best_ns / NS_PER_S,
                        "error_s": _finite(life.points[0].bounds.error_ns / NS_PER_S),
                    }
                    for life in self.lives.get(host, ())
                ],
            }
            for host in dict.fromkeys(self.hosts.values())
        }


def describe(clocks: HostClocks) -> list[str]:
    """Return a line for each host: its offset, how well it is known, its drift, its services."""
    lines = []
    for host in dict.fromkeys(clocks.hosts.values()):
        services = services_on(clocks.hosts, host)
        lives = clocks.lives.get(host, ())
        if services == ["simulator"] and not lives:
            continue  # a real robot's file names it too
        if host == clocks.hosts[RECORDER]:
            words = "the recorder's"
        else:
            words = "; then it started again: ".join(map(_describe_life, lives))
        lines.append(f"{host}: {words or 'not known'} ({', '.join(services)})")
    return lines


def _describe_life(life: ClockLife) -> str:
    first, last = life.points[0], life.points[-1]
    begin, end = first.bounds, last.bounds
    if begin.best_ns == 0.0:
        return "the recorder's, by the times of its messages"
    words = f"{begin.best_ns / NS_PER_S:+.4f} s to the recorder's, "
    if not begin.known:
        return f"{words}less the network's delay: nothing tells how long its messages take"
    words += f"within {begin.error_ns / NS_PER_MS:.1f} ms"
    span_ns = last.at_ns - first.at_ns
    if span_ns and end.known:
        drift, error = (end.best_ns - begin.best_ns) / span_ns, begin.error_ns + end.error_ns
        words += f"; drifts {1e6 * drift:+.0f} ± {1e6 * error / span_ns:.0f} ppm"
    return words


def services_on(hosts: Mapping[str, str], host: str) -> list[str]:
    """Return the services of a host."""
    return [name for name, its in hosts.items() if its == host]


def hosts_of(endpoints: Mapping[str, Any]) -> dict[str, str]:
    """Return the host of each service, as its endpoint on the bus names it."""
    return {
        service: _host_of(endpoint) for service, endpoint in endpoints.items()
        if service in SERVICES and isinstance(endpoint, str)
    }  # fmt: skip


def spans_of_lives(samples: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return from when to when each life of a clock was seen, recorder's clock.

    A sample is a time and the smallest of reception less sender's time there.
    """
    if not samples:
        return []
    jumps = [
        n
        for n, (before, after) in enumerate(pairwise(samples), 1)
        if abs(after[1] - before[1]) > JUMP_NS
    ]
    edges = [0, *jumps, len(samples)]
    return [(samples[a][0], samples[b - 1][0]) for a, b in pairwise(edges)]


def bounds_in(log: Messages, hosts: Mapping[str, str]) -> dict[str, OffsetBounds]:
    """Return what a short part of a run says of each host's clock."""
    clocks = ClockOffsets(tuple(dict.fromkeys(hosts.values())))
    for sender, sent_ns, receiver, received_ns in _heard(log):
        if sender in hosts and receiver in hosts:
            clocks.heard(hosts[sender], sent_ns, hosts[receiver], received_ns)
    return clocks.against(hosts[RECORDER])


def _heard(log: Messages) -> Iterator[tuple[str, int, str, int]]:
    """Yield sender, its time, receiver and a time at which that one surely had the message."""
    for topic in topics.TOPICS:
        for module in MODULES if topic.per_module else ("",):
            sender = sender_of(topic, module)
            rows = zip(log.messages(topic, module), log.received_ns(topic, module), strict=True)
            for message, received_ns in rows if sender else ():
                if log.holds(received_ns):
                    yield sender, message.t_ns, RECORDER, received_ns
    for module in MODULES:
        yield from _commands_taken(log, module)
    yield from _inputs_taken(log)


def _commands_taken(log: Messages, module: str) -> Iterator[tuple[str, int, str, int]]:
    """Yield commands: a cycle reads its time before it takes one, so the next cycle's time counts.

    What came between may be a pause of the process.
    """
    commands = log.messages(topics.JOINT_COMMAND, module)
    sent = {(row.session, row.seq): row.t_ns for row in commands}
    cycles = [cycle for trace in log.messages(topics.JOINT_TRACE, module) for cycle in trace.cycles]
    for cycle, after in pairwise(cycles):
        sent_ns = sent.get((cycle.session, cycle.command_seq))
        if sent_ns is not None and after.now_ns > cycle.now_ns:
            yield PLANNER, sent_ns, module, after.now_ns


def _inputs_taken(log: Messages) -> Iterator[tuple[str, int, str, int]]:
    """Yield the planner's inputs: those of this look came before the tick's end."""
    statuses = log.messages(topics.PLANNER_STATUS)
    states = [_numbered(log.messages(topics.JOINT_STATE, module)) for module in MODULES]
    wrenches = _numbered(log.messages(topics.WRENCH))
    attitudes = _numbered(log.messages(topics.ATTITUDE))
    for status in statuses:
        ended_ns = status.t_ns + math.ceil(min(status.tick_us, 1e6) * NS_PER_US)
        for module, sent, seq, age_ns in zip(
            MODULES, states, status.state_seq, status.state_age_ns, strict=True
        ):
            if seq in sent and age_ns >= 0:
                yield module, sent[seq], PLANNER, status.t_ns if age_ns else ended_ns
        if status.wrench_seq in wrenches:
            yield "harness", wrenches[status.wrench_seq], PLANNER, ended_ns
        if status.attitude_seq in attitudes:
            yield "imu", attitudes[status.attitude_seq], PLANNER, ended_ns


def _numbered(messages: Sequence[Any]) -> dict[int, int]:
    """Return the time of each by its number; nothing if a restart gave a number twice."""
    found = {message.seq: message.t_ns for message in messages}
    return found if len(found) == len(messages) else {}


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _host_of(endpoint: str) -> str:
    found = re.match(r"(?:tls|tcp)/(\[[^\]]+\]|[^:]+):", endpoint)
    return found[1].strip("[]") if found else THIS_HOST
