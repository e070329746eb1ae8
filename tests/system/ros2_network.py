"""A network of ROS 2 on this machine: its router, and a client that is not the project's."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Iterator
from typing import Any

import zenoh
import zenoh.ext
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.discovery import _parse_liveliness_keyexpr
from zenoh_ros2_sdk.keyexpr import topic_keyexpr
from zenoh_ros2_sdk.utils import ros2_to_dds_type

from tests.ros2_gateway.others import TYPES, read


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


@contextlib.contextmanager
def session(mode: str, **settings: object) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    given = {"mode": mode, "scouting/multicast/enabled": False, "timestamping/enabled": True}
    for key, value in {**given, **settings}.items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    opened = zenoh.open(config)
    try:
        yield opened
    finally:
        opened.close()


@contextlib.contextmanager
def router(port: int) -> Iterator[None]:
    with session("router", listen__endpoints=[f"tcp/127.0.0.1:{port}"]):
        yield


class OtherNode:
    """Finds topics by their tokens, and reads them by their types' own hashes."""

    def __init__(self, opened: zenoh.Session, domain: int) -> None:
        self._session, self._domain = opened, domain
        self._subscribers: list[Any] = []
        self.attachments: dict[str, list[Attachment]] = {}
        self.received: dict[str, list[Any]] = {}

    def topics(self) -> dict[str, dict[str, Any]]:
        """Return every publisher in the graph by its topic, as the other one reads its token."""
        replies = self._session.liveliness().get(f"@ros2_lv/{self._domain}/**", timeout=0.5)
        keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        parsed = [row for row in map(_parse_liveliness_keyexpr, keys) if row is not None]
        return {row["qualified_name"]: row for row in parsed if row["kind"] == "MP"}

    def key(self, topic: str, type_name: str) -> str:
        dds, type_hash = ros2_to_dds_type(type_name), TYPES[type_name].hash_rihs01()
        key: str = topic_keyexpr(self._domain, topic, dds, type_hash)
        return key

    def subscribe(self, topic: str, type_name: str, *, late: bool = False) -> None:
        """Receive a topic; `late`: what was sent before as well."""

        def take(sample: zenoh.Sample) -> None:
            message = read(type_name, sample.payload.to_bytes())
            self.received.setdefault(topic, []).append(message)
            if sample.attachment is not None:
                attachment = Attachment.from_bytes(sample.attachment.to_bytes())
                self.attachments.setdefault(topic, []).append(attachment)

        key = self.key(topic, type_name)
        if late:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
            subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                self._session, key, take, history=history
            )
        else:
            subscriber = self._session.declare_subscriber(key, take)
        self._subscribers.append(subscriber)

    def publish(self, topic: str, type_name: str, **fields: object) -> None:
        self._session.put(self.key(topic, type_name), TYPES[type_name](**fields).serialize())
