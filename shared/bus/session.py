"""Sessions on the bus, and the links between processes (docs/networks.md).

Only `shared/bus` and the gateway's session with ROS 2 use Zenoh. Every service is a peer with a
fixed endpoint. There is no router, no scouting and no gossip, and a peer forwards nothing. So each
pair of services, except two joint services, has its own link, and a tool links with each service
(`peers_of`). RUST_LOG=info shows Zenoh's own log.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Self, TypeVar

import zenoh

from shared import log
from shared.bus import security, sockets, tls_probe, topics
from shared.bus.codec import encode
from shared.bus.credentials import read_credentials
from shared.bus.messages import Message
from shared.bus.pubsub import (
    BatchSender,
    Latest,
    LatestInBatch,
    Publisher,
    RawPublisher,
    Recording,
    Stream,
    Subscriber,
    put_with_key,
)
from shared.bus.security import alive_prefix, token_key, tools_prefix
from shared.bus.topics import Priority, Topic
from shared.clock import keep_pace
from shared.config.endpoints import host_and_port, is_endpoint
from shared.config.robot_config import SERVICES, RobotConfig, expand
from shared.exceptions import BusError
from shared.joints import MODULES
from shared.links import PAIRS, Pair, endpoint_through
from shared.process import SOCKET_PATH_MAX
from shared.run_directory import private_files

M = TypeVar("M", bound=Message)

_SETTINGS: Final[dict[str, object]] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "listen/timeout_ms": 0,
    "listen/exit_on_failure": True,
    # -1 with exit_on_failure off dials in the background forever; 0 would dial once only.
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    # One object: Zenoh has no keys for its parts.
    "connect/retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 2.0},
    # Otherwise open() waits half a second for absent peers.
    "open/return_conditions/connect_scouted": False,
    "transport/link/tx/keep_alive": 4,
    # A full queue drops at once: a stopped subscriber costs the publisher nothing.
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    "transport/shared_memory/enabled": False,
}
"""Zenoh settings that are the same for every process; measured in docs/networks.md."""

_ONE_RUNTIME: Final = (
    "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),"
    "app:(worker_threads:1))"
)
"""ZENOH_RUNTIME: one thread pool in place of five."""

_PRIORITIES: Final = {
    Priority.REAL_TIME: zenoh.Priority.REAL_TIME,
    Priority.DATA: zenoh.Priority.DATA,
    Priority.BACKGROUND: zenoh.Priority.BACKGROUND,
}
_RECORDING_WAITS_S: Final = 16.0
"""Capacity for messages while the disk is slow, s at their nominal rate: 60 MB for the fleet."""
_ALIVE_TIMEOUT_S: Final = 0.2
_TOOLS_MAX: Final = 128
"""Maximum number of named tools, equal to the maximum number of links."""
_TOOLS_WAITING: Final = 4096
"""Capacity for arrivals and departures of tools; the oldest are dropped."""
_TOOLS_AT_ONCE: Final = 64


def peers_of(name: str, services: Sequence[str] = SERVICES) -> tuple[str, ...]:
    """Return the services that a process dials; all its other peers dial it.

    Each pair is linked once. Joint services dial no peer: they exchange nothing with each other,
    and this tier, which must outlive the others, spends no time on absent peers. Each other service
    dials the joint services and the services before it in `services`; a tool dials all.
    """
    if name in MODULES:
        return ()
    if name not in services:
        return tuple(services)
    central = [service for service in services if service not in MODULES]
    return (*MODULES, *central[: central.index(name)])


def place_of_tool() -> str:
    """Return HOST.PID of this process, for its liveliness token."""
    return f"{re.sub('[^A-Za-z0-9-]', '-', socket.gethostname())}.{os.getpid()}"


class _LinkedTools:
    """Tools linked with this process."""

    def __init__(self, subscriber: Subscriber) -> None:
        self._subscriber = subscriber
        self._names: set[str] = set()

    def names(self) -> tuple[str, ...]:
        """Return each tool as NAME.HOST.PID; never blocks."""
        for _ in range(_TOOLS_AT_ONCE):
            sample = self._subscriber.try_recv()
            if sample is None:
                break
            name = str(sample.key_expr).rpartition("/")[2]
            if sample.kind != zenoh.SampleKind.PUT:
                self._names.discard(name)
            elif len(self._names) < _TOOLS_MAX:
                self._names.add(name)
        return tuple(sorted(self._names))


class Session:
    """One process on the bus. Use it in a `with` statement; see `open_session`."""

    def __init__(
        self, session: zenoh.Session, robot: str, name: str, *, over_tcp: bool = False
    ) -> None:
        self.robot = robot
        self.name = name
        self._session = session
        self._alive_prefix = f"{alive_prefix(robot)}/"
        self._batches: dict[str, BatchSender] = {}
        self._token = session.liveliness().declare_token(token_key(robot, name, place_of_tool()))
        if over_tcp:  # the reference keeps it alive
            self._links = session.info.declare_link_events_listener(self._meet, history=True)

    def __enter__(self) -> Self:
        """Return the session itself."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Close the session."""
        self.close()

    def close(self) -> None:
        """Leave the bus: end all publishers and subscribers, and remove the socket file.

        Takes up to one lease if a peer is stopped; never raises.
        """
        for batch in self._batches.values():
            with contextlib.suppress(zenoh.ZError):
                batch.send()
        with contextlib.suppress(zenoh.ZError):  # it timed out: the process leaves anyway
            self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub

    def publisher(self, topic: Topic, message_type: type[M], module: str = "") -> Publisher[M]:
        """Declare a publisher; call this at start-up, not in a loop.

        `module` is for a topic with one key per module. Raises BusError if the type or the module
        does not fit the topic.
        """
        key = self._key(topic, message_type, module)
        publisher = self._declare(topic, key)
        put = put_with_key(publisher)
        if topic.batch is None:
            return Publisher(publisher, encode, put)
        batch_key = topic.batch.key(self.robot, module)
        if batch_key not in self._batches:
            self._batches[batch_key] = BatchSender(
                put_with_key(self._declare(topic.batch, batch_key))
            )
        batch = self._batches[batch_key]
        return Publisher(publisher, encode, batch.also(key, put, closes=topic.closes))

    def _declare(self, topic: Topic, key: str) -> zenoh.Publisher:
        return self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=_PRIORITIES[topic.priority],
            express=False,
        )

    def raw_publisher(self, key: str, *, patient: bool) -> RawPublisher:
        """Declare a publisher of encoded payloads on any full key.

        Raises BusError if the key is malformed. All these publishers have the same priority, so
        payloads arrive in the order of `put` across all keys. With `patient`, `put` waits up to
        `wait_before_close` (5 s) for a slow subscriber, and then drops the link instead of the
        message. Use it only if nothing waits for the caller.
        """
        control = zenoh.CongestionControl.BLOCK if patient else zenoh.CongestionControl.DROP
        try:
            publisher = self._session.declare_publisher(
                key, congestion_control=control, priority=_PRIORITIES[Priority.DATA], express=False
            )
        except zenoh.ZError as error:
            raise BusError(f"{key}: {_reason(error)}; use a valid key") from None
        return RawPublisher(publisher)

    def latest(self, topic: Topic, message_type: type[M], module: str = "") -> Latest[M]:
        """Declare a subscriber that keeps only the newest message; arguments as for `publisher`."""
        key = self._key(topic, message_type, module)
        return Latest(_ring(self._session, key, 1), message_type)

    def latest_in_batch(
        self, topic: Topic, message_type: type[M], module: str = ""
    ) -> LatestInBatch[M]:
        """Declare a subscriber as `latest` does, but on the batches: no cost to the service."""
        key = self._key(topic, message_type, module)
        if topic.batch is None:
            raise BusError(f"{topic.name} is not in a batch; use `latest`")
        batches = _ring(self._session, topic.batch.key(self.robot, module), 1)
        return LatestInBatch(batches, key, message_type)

    def stream(self, key_expressions: Sequence[str], capacity: int = 65536) -> Stream:
        """Declare a subscriber that keeps every sample, up to `capacity` per expression.

        An expression is a full key, or has wildcards, such as `xrl/lab/joint/*/state`. A sample
        whose key matches two expressions arrives twice. Raises BusError if an expression is
        malformed.
        """
        try:
            return Stream([_ring(self._session, key, capacity) for key in key_expressions])
        except zenoh.ZError as error:
            raise BusError(f"{', '.join(key_expressions)}: {_reason(error)}") from None

    def recording(self) -> Recording:
        """Declare subscribers for everything that is recorded."""
        in_batches, every = topics.keys_by_batch(self.robot), topics.all_keys(self.robot)
        keys = [k for k, t in every.items() if k in in_batches or (t.recorded and not t.batch)]
        waiting = [max(1000, round(_RECORDING_WAITS_S * every[key].rate_hz)) for key in keys]
        return Recording(
            [_ring(self._session, key, most) for key, most in zip(keys, waiting, strict=True)],
            in_batches,
        )

    def alive(self) -> set[str]:
        """Return the services linked with this process, including itself if it is a service.

        For display only: a stopped process counts as alive until its lease is over. Takes up to
        0.2 s; not for a control loop.
        """
        replies = self._session.liveliness().get(self._alive_prefix + "*", timeout=_ALIVE_TIMEOUT_S)
        return {
            str(reply.ok.key_expr).removeprefix(self._alive_prefix)
            for reply in replies
            if reply.ok is not None
        }

    def linked_tools(self) -> _LinkedTools:
        """Declare a watch on the tools that are linked with this process."""
        watched = f"{tools_prefix(self.robot)}/*"
        return _LinkedTools(
            self._session.liveliness().declare_subscriber(
                watched, zenoh.handlers.RingChannel(_TOOLS_WAITING), history=True
            )
        )

    @staticmethod
    def _meet(event: zenoh.LinkEvent) -> None:
        """Make a TCP link close with a reset.

        Zenoh sets SO_LINGER to 10 s and closes links in its only thread. After a cable was cut for
        longer than the lease, each lost link stalled all links for up to 10 s.
        """
        here, there = event.link.src, event.link.dst
        if event.kind == zenoh.SampleKind.PUT and here.startswith(security.TCP):
            sockets.reset_on_close(host_and_port(here), host_and_port(there))

    def _key(self, topic: Topic, message_type: type[Message], module: str) -> str:
        if message_type is not topic.type:
            right = topic.type.__name__
            raise BusError(
                f"{topic.name}: {message_type.__name__} is not its message type; use {right}"
            )
        if topic.per_module and module not in MODULES:
            right = ", ".join(MODULES)
            raise BusError(f"{topic.name}: {module!r} is not a valid module; use one of {right}")
        if module and not topic.per_module:
            raise BusError(f"{topic.name} has no key per module; omit the module")
        return topic.key(self.robot, module)


def open_session(
    config: RobotConfig,
    name: str,
    run_dir: Path,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    only: Sequence[str] | None = None,
    injected: bool = False,
) -> Session:
    """Join the bus and return at once; links form as peers come up.

    Use it as `with open_session(config, "planner", run_dir) as session:`. Raise the priority of the
    process first: Zenoh's thread inherits it. From this call on, the process uses the clock of the
    fleet in `run_dir` (`shared.clock.keep_pace`). A socket that a killed process left behind does
    no harm.

    Args:
        config: the robot; `config.bus` holds the endpoints and the lease.
        name: a service of `robot_config.SERVICES`, which listens on its endpoint, or any other
            name (letters, digits, _ and -) for a tool, which listens only on `listen`.
        run_dir: run directory, whose live directory replaces `{run}` in endpoints.
        listen: further endpoints to listen on, for a tool that serves other tools.
        connect: further endpoints to dial, such as those of a tool that serves others.
        only: services to dial; None: all peers of this process.
        injected: dial through the network proxy on the links that it serves
            (`shared.links.PAIRS`).

    Raises:
        BusError: the name is not allowed, or an endpoint is in use, too long or invalid.
    """
    keep_pace(run_dir)
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise BusError(f"{name!r} is not a valid process name; use letters, digits, _ and - only")
    here = security.services_here(config)
    own = security.listening(config, name, here) if name in SERVICES else ()
    peers = [peer for peer in peers_of(name, config.services) if only is None or peer in only]
    endpoints = [
        endpoint_through(Pair(name, peer))
        if injected and Pair(name, peer) in PAIRS
        else security.endpoint_here(config, peer, here)
        for peer in peers
    ]
    listening = [_endpoint(text, run_dir) for text in (*own, *listen)]
    dialling = [_endpoint(text, run_dir) for text in (*endpoints, *connect)]
    settings = {
        **_SETTINGS,
        **security.settings(config, name, (*listening, *dialling)),
        "transport/link/tx/lease": config.bus.lease_ms,
        # A stopped process accepts a link but never answers; close() waits for that answer.
        "transport/unicast/open_timeout": config.bus.lease_ms,
        "transport/unicast/accept_timeout": config.bus.lease_ms,
        "listen/endpoints": [security.listener(endpoint) for endpoint in listening],
        "connect/endpoints": dialling,
    }
    os.environ.setdefault("ZENOH_RUNTIME", _ONE_RUNTIME)  # read when the first session opens
    zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]  # zenoh's stub
    try:
        for endpoint in listening:
            _make_directory(endpoint)
        zenoh_config = zenoh.Config()
        for key, value in settings.items():
            zenoh_config.insert_json5(key, json.dumps(value))
        over_tcp = any(endpoint.startswith(security.TCP) for endpoint in (*listening, *dialling))
        with private_files():
            opened = zenoh.open(zenoh_config)
        session = Session(opened, config.name, name, over_tcp=over_tcp)
    except (zenoh.ZError, OSError) as error:
        raise _open_error(name, listening, error) from None
    security.limit_queues(config, listening)
    if config.bus.security.mode == "mtls":
        credentials = read_credentials(config, name)
        if fault := tls_probe.own_fault(credentials):
            log.get("xrl").error("no link over TLS: %s %s", credentials.certificate, fault)
    return session


def _ring(session: zenoh.Session, key: str, capacity: int) -> Subscriber:
    """Subscribe without a callback: a full ring drops its oldest and delays no other key."""
    return session.declare_subscriber(key, zenoh.handlers.RingChannel(capacity))


def _endpoint(text: str, run_dir: Path) -> str:
    """Return an endpoint with `{run}` filled in; BusError if it is invalid."""
    endpoint = expand(text, run_dir)
    if endpoint.startswith(security.TCP):
        host_and_port(endpoint)
    elif not is_endpoint(endpoint):
        raise BusError(f"{endpoint}: a socket path must not contain ? or #; use another directory")
    length = len(os.fsencode(endpoint.removeprefix(security.UNIX)))
    if endpoint.startswith(security.UNIX) and length > SOCKET_PATH_MAX:
        raise BusError(
            f"{endpoint}: the socket path has {length} bytes, "
            f"but at most {SOCKET_PATH_MAX} are possible; choose a shorter run directory"
        )
    return endpoint


def _make_directory(endpoint: str) -> None:
    """Make the directory of a UNIX socket, for its owner only."""
    if endpoint.startswith(security.UNIX):
        directory = Path(endpoint.removeprefix(security.UNIX)).parent
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)


def _open_error(name: str, listen: Sequence[str], error: Exception) -> BusError:
    """Return a one-line error: why a session could not be opened, and the remedy."""
    where = ", ".join(listen) or "bus"
    reason = _reason(error)
    # EAGAIN is the lock that Zenoh holds beside a UNIX socket while it listens there.
    if "EAGAIN" in reason or "Address already in use" in reason:
        if dead := [endpoint for endpoint in listen if _is_dead(endpoint)]:
            right = "find out why (`dmesg`): its disk may be read-only"
            return BusError(f"{dead[0]}: this dead socket cannot be removed; {right}")
        right = f"stop the {name} that is already running, or choose another run directory"
        return BusError(f"{where}: in use; {right}")
    return BusError(f"{where}: {name} cannot listen: {reason}; choose another endpoint")


def _is_dead(endpoint: str) -> bool:
    """Return True for a UNIX socket on which no process listens."""
    if not endpoint.startswith(security.UNIX):
        return False
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        return probe.connect_ex(endpoint.removeprefix(security.UNIX)) == errno.ECONNREFUSED


def _reason(error: Exception) -> str:
    """Return an error's text without the location in Zenoh's source at its end."""
    return str(error).partition(" at /")[0]
