"""Session of a node on the Zenoh network of ROS 2, separate from the robot's own bus."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final, Self, TypeAlias

import zenoh
import zenoh.ext

from services.ros2_gateway import rmw
from services.ros2_gateway.conversions import RosTypes
from services.ros2_gateway.rmw import RosNode, RosTopic, SeenEndpoint
from shared.exceptions import BusError

NODE: Final = "xrl"
"""Name of the gateway's node."""
_SETTINGS: Final[dict[str, object]] = {
    # A router forwards everything to a client, and the client redials a lost router. Peers cannot
    # connect: this session does not listen, and the peers of ROS 2 listen only on their loopback.
    "mode": "client",
    "scouting/multicast/enabled": False,
    "connect/timeout_ms": 1000,
    "connect/exit_on_failure": True,
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 2.0},
    "timestamping/enabled": True,  # needed by the cache of a transient-local publisher
}
_QUEUE: Final = 64
_ANSWER_S: Final = 0.5
_AGAIN_S: Final = 1.0
_Subscriber: TypeAlias = "zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]"


class RosSession:
    """A node with publishers and subscriptions. Use it in a `with` statement."""

    def __init__(
        self, router: str, domain: int, types: RosTypes, *, namespace: str = "", name: str = NODE
    ) -> None:
        """Connect to the router; raise BusError if it does not answer within a second."""
        config = zenoh.Config()
        for key, value in {**_SETTINGS, "connect/endpoints": [router]}.items():
            config.insert_json5(key, json.dumps(value))
        try:
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise BusError(
                f"{router}: no ROS 2 router answers: {error}; start one "
                "(ros2 run rmw_zenoh_cpp rmw_zenohd), or correct ros2.router"
            ) from None
        self._types, self._domain = types, domain
        self._node = RosNode(domain, str(self._session.zid()), f"/{namespace}", name)
        self._tokens: list[zenoh.LivelinessToken] = []
        self._publishers: dict[RosTopic, _RosPublisher] = {}
        self._subscribers: list[tuple[RosTopic, _Subscriber]] = []
        self._endpoints = 0
        self.failed = 0
        """Number of messages that could not be sent."""

    def __enter__(self) -> Self:
        """Return the session."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Close the session."""
        self.close()

    def close(self) -> None:
        """Leave the network; its graph then no longer shows the node and its topics."""
        with contextlib.suppress(zenoh.ZError):  # it timed out; the process ends anyway
            self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub

    def show_node(self) -> None:
        """Announce the node in the graph."""
        self._show(rmw.node_token(self._node))

    def publish(self, topics: Sequence[RosTopic]) -> None:
        """Declare the publishers of topics."""
        for topic in topics:
            type_hash = self._types.hash(topic.type)
            key = rmw.topic_key(self._domain, topic, type_hash)
            token = self._endpoint("MP", topic, type_hash)
            options: dict[str, Any] = {"congestion_control": zenoh.CongestionControl.DROP}
            if topic.qos.transient_local:
                options["cache"] = zenoh.ext.CacheConfig(topic.qos.depth)
                options["publisher_detection"] = True
                publisher: Any = zenoh.ext.declare_advanced_publisher(self._session, key, **options)
            else:
                publisher = self._session.declare_publisher(key, **options)
            self._publishers[topic] = _RosPublisher(publisher, rmw.gid_of(token))

    def subscribe(self, topics: Sequence[RosTopic]) -> None:
        """Declare subscriptions to topics."""
        for topic in topics:
            type_hash = self._types.hash(topic.type)
            key = rmw.topic_key(self._domain, topic, type_hash)
            subscriber = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(_QUEUE))
            self._subscribers.append((topic, subscriber))
            self._endpoint("MS", topic, type_hash)

    def put(self, topic: RosTopic, payload: bytes) -> None:
        """Send a message in CDR; never blocks and never raises."""
        try:
            self._publishers[topic].put(payload)
        except zenoh.ZError:
            self.failed += 1

    def take(self) -> list[tuple[RosTopic, Any | None]]:
        """Return the messages since the last call; None for each that could not be decoded."""
        found = []
        for topic, subscriber in self._subscribers:
            for _ in range(_QUEUE):  # limited, so a flood on one topic does not starve the next
                sample = subscriber.try_recv()
                if sample is None:
                    break
                found.append((topic, self._types.decode(topic.type, sample.payload.to_bytes())))
        return found

    def graph(self) -> list[SeenEndpoint]:
        """Return all nodes and endpoints of the domain; takes up to half a second."""
        replies = self._session.liveliness().get(
            f"{rmw.ADMIN_SPACE}/{self._domain}/**", timeout=_ANSWER_S
        )
        keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        return [seen for seen in map(rmw.read_token, sorted(keys)) if seen is not None]

    def _endpoint(self, kind: rmw.Kind, topic: RosTopic, type_hash: str) -> str:
        self._endpoints += 1
        token = rmw.endpoint_token(self._node, self._endpoints, kind, topic, type_hash)
        self._show(token)
        return token

    def _show(self, token: str) -> None:
        self._tokens.append(self._session.liveliness().declare_token(token))


class RosLink:
    """Opens a session in its own thread, and retries until the router answers.

    `opened` opens the session and declares its topics, and raises if no router answers. `failed`
    is called with the first failure.
    """

    def __init__(
        self, opened: Callable[[], RosSession], failed: Callable[[Exception], None]
    ) -> None:
        self._open, self._failed = opened, failed
        self._left = threading.Event()
        self.session: RosSession | None = None
        """The session once it is open, else None; it stays open even if its router ends."""
        self._thread = threading.Thread(target=self._dial, name="ros2-router", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the network."""
        self._left.set()
        self._thread.join()
        if self.session is not None:
            self.session.close()

    def _dial(self) -> None:
        reported = False
        while not self._left.is_set():
            try:
                self.session = self._open()
                return
            except (BusError, zenoh.ZError) as error:
                if not reported:
                    self._failed(error)
                reported = True
                self._left.wait(_AGAIN_S)


class _RosPublisher:
    """A publisher that counts its messages."""

    def __init__(self, publisher: Any, gid: bytes) -> None:
        self._publisher, self._gid, self._number = publisher, gid, 0

    def put(self, payload: bytes) -> None:
        self._number += 1
        attachment = rmw.attachment(self._number, time.time_ns(), self._gid)
        self._publisher.put(payload, attachment=attachment)
