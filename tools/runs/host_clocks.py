"""The clocks of the hosts in a run: what brings the times of each service to the recorder's.

A message carries its sender's time, and a host's clock counts from its own start: the record of
several hosts holds several times, hours apart. What lies between them is found from the messages
themselves (`tools/runs/clock_offsets.py`), where the run begins and where it ends; in between it
changes evenly, for clocks drift.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol

from shared.bus import topics
from shared.bus.topics import RECORDER, Topic
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import SERVICES
from shared.robot.joints import MODULES
from tools.runs.clock_offsets import ClockOffsets, OffsetBounds

PLANNER: Final = "planner"
THIS_HOST: Final = "this host"
"""Name of the host of services whose endpoint is a socket in the file system."""
TAKEN_NS: Final = 200_000
"""A cycle reads its time, and takes messages until so much later."""


class Messages(Protocol):
    """What is read of a run: a `tools.runs.run_log.RunLog` with times as they were sent."""

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        """Return the messages of a topic."""

    def received_ns(self, topic: Topic, module: str = "") -> list[int]:
        """Return when the recorder got each, on its own clock."""


class ClockLook(NamedTuple):
    """How the clocks stood in a short part of the run."""

    at_ns: int
    """Middle of it, recorder's clock."""
    bounds: Mapping[str, OffsetBounds]
    """By host: what brings its times to the recorder's."""


class HostClocks:
    """Offsets of all hosts of a run against its recorder's.

    Attributes:
        hosts: host of each service.
        looks: where the run begins, and where it ends if that is later.
    """

    def __init__(self, hosts: Mapping[str, str], looks: Sequence[ClockLook]) -> None:
        """Take what `look` found.

        Args:
            hosts: host of each service.
            looks: one or two.
        """
        self.hosts, self.looks = hosts, looks

    def offset_ns(self, topic: Topic, module: str, received_ns: int) -> int:
        """Return what brings a message's times to the recorder's clock; 0 if that is unknown.

        Args:
            topic: of the message.
            module: its module, or "".
            received_ns: when the recorder got it, on its own clock.
        """
        return self.offset_of_ns(self.hosts.get(sender_of(topic, module), ""), received_ns)

    def knows(self, host: str) -> bool:
        """Return True if something is known of a host's clock."""
        return any(
            host in look.bounds and math.isfinite(look.bounds[host].best_ns) for look in self.looks
        )

    def offset_of_ns(self, host: str, at_ns: int) -> int:
        """Return what brings a host's times to the recorder's clock; 0 if that is unknown.

        Args:
            host: its name.
            at_ns: at this time of the recorder's clock.
        """
        found = [
            (look.at_ns, look.bounds[host].best_ns)
            for look in self.looks
            if host in look.bounds and math.isfinite(look.bounds[host].best_ns)
        ]
        if not found:
            return 0
        (begin_ns, begin), (end_ns, end) = found[0], found[-1]
        if end_ns == begin_ns:
            return round(begin)
        return round(begin + (end - begin) * (at_ns - begin_ns) / (end_ns - begin_ns))

    def as_json(self) -> dict[str, Any]:
        """Return each host: services, and where the run begins its offset and the error of that."""
        return {
            host: {
                "services": [name for name, its in self.hosts.items() if its == host],
                **_as_json(bounds),
            }
            for host, bounds in self.looks[0].bounds.items()
        }


def _as_json(bounds: OffsetBounds) -> dict[str, float | None]:
    best_s, error_s = bounds.best_ns / NS_PER_S, bounds.error_ns / NS_PER_S
    return {
        "offset_s": best_s if math.isfinite(best_s) else None,
        "error_s": error_s if math.isfinite(error_s) else None,
    }


def describe(clocks: HostClocks) -> list[str]:
    """Return a line for each host: its offset, how well it is known, its drift, its services."""
    first, last = clocks.looks[0], clocks.looks[-1]
    here = clocks.hosts[RECORDER]
    lines = []
    for host in dict.fromkeys(clocks.hosts.values()):
        services = ", ".join(name for name, its in clocks.hosts.items() if its == host)
        begin, end = first.bounds[host], last.bounds[host]
        if services == "simulator" and not math.isfinite(begin.best_ns):
            continue  # a real robot's file names it too
        if host == here:
            words = "the recorder's"
        elif not math.isfinite(begin.best_ns):
            words = "unknown: it was not heard"
        elif begin.best_ns == 0.0:
            words = "the recorder's, by the times of its messages"
        else:
            words = f"{begin.best_ns / NS_PER_S:+.4f} s to the recorder's, "
            if begin.known:
                words += f"within {begin.error_ns / NS_PER_MS:.1f} ms"
            else:
                words += "less the network's delay: it received nothing"
            if last.at_ns > first.at_ns and begin.known and end.known:
                drift = (end.best_ns - begin.best_ns) / (last.at_ns - first.at_ns)
                words += f"; drifts {1e6 * drift:+.0f} ppm"
        lines.append(f"{host}: {words} ({services})")
    return lines


def hosts_of(endpoints: Mapping[str, Any]) -> dict[str, str]:
    """Return the host of each service, as its endpoint on the bus names it."""
    return {
        service: _host_of(endpoint) for service, endpoint in endpoints.items()
        if service in SERVICES and isinstance(endpoint, str)
    }  # fmt: skip


def sender_of(topic: Topic, module: str = "") -> str:
    """Return the service that puts a topic; "" if tools do, on any host."""
    if topic.writers == ("*",):
        return module
    return topic.writers[0] if len(topic.writers) == 1 and topic.writers[0] in SERVICES else ""


def look(log: Messages, hosts: Mapping[str, str], at_ns: int) -> ClockLook:
    """Find the offsets in a short part of a run.

    Args:
        log: the part, a few seconds.
        hosts: host of each service.
        at_ns: middle of the part.
    """
    clocks = ClockOffsets(tuple(dict.fromkeys(hosts.values())))
    for sender, sent_ns, receiver, received_ns in _heard(log):
        if sender in hosts and receiver in hosts:
            clocks.heard(hosts[sender], sent_ns, hosts[receiver], received_ns)
    return ClockLook(at_ns, clocks.against(hosts[RECORDER]))


def _heard(log: Messages) -> Iterator[tuple[str, int, str, int]]:
    """Yield sender, its time, receiver and its time, of messages that bound clocks most tightly."""
    for topic in topics.TOPICS:
        for module in MODULES if topic.per_module else ("",):
            sender = sender_of(topic, module)
            rows = zip(log.messages(topic, module), log.received_ns(topic, module), strict=True)
            if sender:
                for message, received_ns in rows:
                    yield sender, message.t_ns, RECORDER, received_ns
    for module in MODULES:
        yield from _commands_taken(log, module)
    yield from _inputs_taken(log)


def _commands_taken(log: Messages, module: str) -> Iterator[tuple[str, int, str, int]]:
    commands = log.messages(topics.JOINT_COMMAND, module)
    sent = {(row.session, row.seq): row.t_ns for row in commands}
    for trace in log.messages(topics.JOINT_TRACE, module):
        for cycle in trace.cycles:
            sent_ns = sent.get((cycle.session, cycle.command_seq))
            if sent_ns is not None:
                yield PLANNER, sent_ns, module, cycle.now_ns + TAKEN_NS


def _inputs_taken(log: Messages) -> Iterator[tuple[str, int, str, int]]:
    statuses = log.messages(topics.PLANNER_STATUS)
    states = [_numbered(log.messages(topics.JOINT_STATE, module)) for module in MODULES]
    wrenches = _numbered(log.messages(topics.WRENCH))
    attitudes = _numbered(log.messages(topics.ATTITUDE))
    for status in statuses:
        now_ns = status.t_ns + TAKEN_NS
        for module, sent, seq, age_ns in zip(
            MODULES, states, status.state_seq, status.state_age_ns, strict=True
        ):
            if seq in sent and age_ns >= 0:
                yield module, sent[seq], PLANNER, now_ns - age_ns
        if status.wrench_seq in wrenches:
            yield "harness", wrenches[status.wrench_seq], PLANNER, now_ns
        if status.attitude_seq in attitudes:
            yield "imu", attitudes[status.attitude_seq], PLANNER, now_ns


def _numbered(messages: Sequence[Any]) -> dict[int, int]:
    """Return the time of each by its number; nothing if a restart gave a number twice."""
    found = {message.seq: message.t_ns for message in messages}
    return found if len(found) == len(messages) else {}


def _host_of(endpoint: str) -> str:
    found = re.match(r"(?:tls|tcp)/(\[[^\]]+\]|[^:]+):", endpoint)
    return found[1].strip("[]") if found else THIS_HOST
