"""The clocks of the hosts in a run: what brings the times of each service to the recorder's.

A message carries its sender's time, and a host's monotonic clock counts from its own start: the
record of several hosts holds several times, hours apart. What lies between them is found from the
messages themselves. None can arrive before it was sent: if a sends at t_a and b has it at t_b, each
on its own clock, then

    t_a + offset_a <= t_b + offset_b

with offset_h what brings the clock of h to that of the reference. Messages in both directions bound
an offset from both sides, and the width between the bounds is the shortest way there and back. That
is true whatever the delays are, and also where they differ by direction, for as long as the clocks
do not drift apart meanwhile. Bounds add up over hosts in between: they are shortest paths (Floyd
and Warshall).

A record of an hour is not read for that. A chunk now and then tells when a host restarted: it has a
second clock from then on. A few seconds where each clock is first and last heard tell how it
stands; in between it changes evenly, for clocks drift. What is not known is not guessed: such a
message has the time at which the recorder got it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations, pairwise, product
from typing import Any, Final, NamedTuple, Protocol, TypeAlias

from shared.bus import topics
from shared.bus.topics import RECORDER, Topic
from shared.clock import NS_PER_MS, NS_PER_S, NS_PER_US
from shared.joints import MODULES
from tools.logs.run_index import RunIndex
from tools.topic_keys import every_key, sender_of

PLANNER: Final = "planner"
ONE_CLOCK_NS: Final = 20 * NS_PER_MS
"""Bounds that are so narrow and hold 0 are those of one clock."""
DRIFT_NS: Final = NS_PER_MS
"""Bounds may contradict each other by this much, because clocks drift; beyond it none holds."""
TIME_MAX_NS: Final = 1 << 62
"""More than any monotonic clock shows."""
LATE_MAX_NS: Final = 60 * NS_PER_S
"""A message that seems to take longer is of a clock that is not known."""
JUMP_NS: Final = NS_PER_S
"""A clock whose offset changes by more than this from one sample to the next has restarted."""
LOOK_NS: Final = 5 * NS_PER_S
"""Length of the part in which the hosts' clocks are compared."""
LONG_NS: Final = 60 * NS_PER_S
"""Where a host is heard for longer they are compared a second time, at its end."""
LOOKS_MAX: Final = 16
SAMPLE_NS: Final = 10 * NS_PER_S
"""Time between two looks for a restart of a host."""
SAMPLES_MAX: Final = 400

Heard: TypeAlias = tuple[str, int, str, int]
"""Sender, its time, receiver, and a time of that one at which it surely had the message."""


class SentMessages(Protocol):
    """Messages of a part of a run, with all times as they were sent (`RunLog`)."""

    def messages(self, topic: Topic, module: str = "", /) -> list[Any]:
        """Return the messages of a topic."""

    def received_ns(self, topic: Topic, module: str = "", /) -> list[int]:
        """Return when each of them reached the recorder, on its host's clock."""

    def holds(self, received_ns: int, /) -> bool:
        """Return True for a message of this part, False for one of its margins."""


class OffsetBounds(NamedTuple):
    """What has to be added to a host's times to get the reference's; ns."""

    low_ns: float
    """-inf: the host has received nothing."""
    high_ns: float
    """inf: nothing has been received from it."""

    @property
    def known(self) -> bool:
        """True if it is bounded from both sides."""
        return math.isfinite(self.low_ns) and math.isfinite(self.high_ns)

    @property
    def best_ns(self) -> float:
        """The middle; with one bound only, that one: the shortest delay taken for none.

        Narrow bounds that hold 0 are those of one clock: no two hosts started at the same time to
        some milliseconds. NaN if nothing is known.
        """
        if self.known:
            one = self.low_ns <= 0.0 <= self.high_ns and self.high_ns - self.low_ns < ONE_CLOCK_NS
            return 0.0 if one else 0.5 * (self.low_ns + self.high_ns)
        return next((b for b in (self.high_ns, self.low_ns) if math.isfinite(b)), math.nan)

    @property
    def error_ns(self) -> float:
        """Largest error of `best_ns`; inf if it is not known."""
        return max(self.high_ns - self.best_ns, self.best_ns - self.low_ns)


UNKNOWN: Final = OffsetBounds(-math.inf, math.inf)


def offset_bounds(
    reference: str, hosts: Iterable[str], heard: Iterable[Heard]
) -> dict[str, OffsetBounds]:
    """Return the bounds of each host's offset against a reference, which is one of them.

    A host that contradicts itself by more than clocks drift has restarted meanwhile: it is not
    known, and bounds no other. Bounds that contradict each other by less have changed places, and
    are put back.
    """
    names = tuple(dict.fromkeys(hosts))
    most = dict.fromkeys(product(names, repeat=2), math.inf)
    """[a, b]: offset_a - offset_b is at most this, ns."""
    for sender, sent_ns, receiver, received_ns in heard:
        if max(abs(sent_ns), abs(received_ns)) < TIME_MAX_NS:
            most[sender, receiver] = min(most[sender, receiver], received_ns - sent_ns)
    contradicting = {
        host
        for pair in combinations(names, 2)
        if most[pair] + most[pair[::-1]] < -DRIFT_NS
        for host in pair
    }
    for a, b in most:
        if a == b:
            most[a, b] = 0.0
        elif {a, b} & contradicting - {reference}:
            most[a, b] = math.inf
    for via, a, b in product(names, repeat=3):
        most[a, b] = min(most[a, b], most[a, via] + most[via, b])
    found = {}
    for host in names:
        low, high = -most[reference, host], most[host, reference]
        crossed = low > high + DRIFT_NS
        found[host] = UNKNOWN if crossed else OffsetBounds(min(low, high), max(low, high))
    return found | {reference: OffsetBounds(0.0, 0.0)}


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

    def describe(self) -> str:
        """Return its offset in words, how well it is known, and its drift."""
        first, last = self.points[0], self.points[-1]
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


class HostClocks(NamedTuple):
    """The clocks of all hosts of a run against its recorder's."""

    hosts: Mapping[str, str]
    """Host of each service."""
    lives: Mapping[str, Sequence[ClockLife]]
    """By host: of its clock, in the order in which they were heard."""

    @property
    def services(self) -> dict[str, list[str]]:
        """Services of each host."""
        found: dict[str, list[str]] = {host: [] for host in self.hosts.values()}
        for service, host in self.hosts.items():
            found[host].append(service)
        return found

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
        found = {}
        for host, services in self.services.items():
            firsts = [life.points[0].bounds for life in self.lives.get(host, ())]
            errors = [row.error_ns / NS_PER_S for row in firsts]
            clocks = [
                {
                    "offset_s": row.best_ns / NS_PER_S,
                    "error_s": error if math.isfinite(error) else None,
                }
                for row, error in zip(firsts, errors, strict=True)
            ]
            found[host] = {"services": services, "clocks": clocks}
        return found

    def describe(self) -> list[str]:
        """Return a line for each host: its clock and its services."""
        lines = []
        for host, services in self.services.items():
            lives = self.lives.get(host, ())
            if services == ["simulator"] and not lives:
                continue  # a real robot's file names it too
            words = "; then it started again: ".join(life.describe() for life in lives)
            words = "the recorder's" if RECORDER in services else words or "not known"
            lines.append(f"{host}: {words} ({', '.join(services)})")
        return lines


def find_clocks(index: RunIndex, read: Callable[[float, float], SentMessages]) -> HostClocks | None:
    """Compare the clocks of a run's hosts; None if all its services ran on one.

    `read` returns the part from and to s since the first message.
    """
    hosts = index.hosts
    if RECORDER not in hosts or len(set(hosts.values())) == 1:
        return None
    lives: dict[str, list[ClockLife]] = {host: [] for host in hosts.values()}
    seen: dict[int, dict[str, OffsetBounds]] = {}
    for host, samples in _samples_of_hosts(index, hosts).items():
        for first_ns, last_ns in _spans_of_lives(samples):
            points = []
            for at_ns in _looks_in(first_ns, last_ns):
                if at_ns not in seen and len(seen) < LOOKS_MAX:
                    edges = (at_ns - LOOK_NS // 2, at_ns + LOOK_NS // 2)
                    part = read(*((t_ns - index.began_ns) / NS_PER_S for t_ns in edges))
                    heard = (
                        (hosts[sender], sent_ns, hosts[receiver], received_ns)
                        for sender, sent_ns, receiver, received_ns in _heard(part)
                        if sender in hosts and receiver in hosts
                    )
                    seen[at_ns] = offset_bounds(hosts[RECORDER], hosts.values(), heard)
                bounds = seen.get(at_ns, {}).get(host, UNKNOWN)
                if math.isfinite(bounds.best_ns):
                    points.append(ClockPoint(at_ns - index.offset_ns, bounds))
            if points:
                lives[host].append(ClockLife(tuple(points)))
    return HostClocks(hosts, lives)


def _samples_of_hosts(
    index: RunIndex, hosts: Mapping[str, str]
) -> dict[str, list[tuple[int, int]]]:
    """Return for each host, now and then, the smallest of reception less sender's time, ns."""
    of_key = {
        key.topic.key(index.robot, key.module): hosts.get(sender_of(*key), "")
        for key in every_key()
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


def _spans_of_lives(samples: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return from when to when each life of a clock was seen in its samples."""
    late_ns = [late for _, late in samples]
    jumps = [n for n, (a, b) in enumerate(pairwise(late_ns), 1) if abs(b - a) > JUMP_NS]
    edges = [0, *jumps, len(samples)]
    return [(samples[a][0], samples[b - 1][0]) for a, b in pairwise(edges) if a < b]


def _looks_in(first_ns: int, last_ns: int) -> tuple[int, ...]:
    """Return where to look closely in the life of a clock, log time: at its begin and its end."""
    if last_ns - first_ns < LONG_NS:
        return (first_ns + min(LOOK_NS // 2, (last_ns - first_ns) // 2),)
    return first_ns + LOOK_NS // 2, last_ns - LOOK_NS // 2


def _heard(log: SentMessages) -> Iterator[Heard]:
    for topic, module in every_key():
        sender = sender_of(topic, module)
        rows = zip(log.messages(topic, module), log.received_ns(topic, module), strict=True)
        for message, received_ns in rows if sender else ():
            if log.holds(received_ns):
                yield sender, message.t_ns, RECORDER, received_ns
    for module in MODULES:
        yield from _commands_taken(log, module)
    yield from _inputs_taken(log)


def _commands_taken(log: SentMessages, module: str) -> Iterator[Heard]:
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


def _inputs_taken(log: SentMessages) -> Iterator[Heard]:
    """Yield the planner's inputs: those of this look came before the tick's end."""
    states = [_numbered(log.messages(topics.JOINT_STATE, module)) for module in MODULES]
    wrenches = _numbered(log.messages(topics.WRENCH))
    attitudes = _numbered(log.messages(topics.ATTITUDE))
    for status in log.messages(topics.PLANNER_STATUS):
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
