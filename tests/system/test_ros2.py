"""A live fleet, seen and stopped by a node of ROS 2 that is not the project's."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.discovery import _parse_liveliness_keyexpr
from zenoh_ros2_sdk.keyexpr import topic_keyexpr
from zenoh_ros2_sdk.utils import ros2_to_dds_type

from shared.bus.messages import Mode
from shared.joints import JOINTS, MODULES
from shared.places import DEFAULT_CONFIG
from tests.ros2_gateway.others import TYPES, read
from tests.system.fleets import wait_for, xrl

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]

DOMAIN = 37


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


def robot_file(folder: Path, port: int) -> Path:
    path = folder / "robot.toml"
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    path.write_text(f'{text}\n[ros2]\nrouter = "tcp/127.0.0.1:{port}"\n', encoding="utf-8")
    shutil.copy(DEFAULT_CONFIG.with_suffix(".gains.json"), folder / "robot.gains.json")
    return path


def test_a_node_of_another_finds_the_robot_reads_it_all_leads_it_a_little_and_stops_it(
    run_dir: Path, tmp_path: Path
) -> None:
    port = free_port()
    asked = ("--config", robot_file(tmp_path, port), "--domain", str(DOMAIN))
    up = xrl("up", *asked, "--out", tmp_path / "run", "--ros2", "--accept", "intent,estop",
             "--scenario", "squat", run_dir=run_dir)  # fmt: skip
    assert up.returncode == 0, up.stderr
    try:
        absent = xrl("ros2", "check", *asked, "--wait", "1")
        assert absent.returncode == 3, "the router comes later"
        assert "does not answer" in absent.stdout
        with router(port), session("peer", connect__endpoints=[f"tcp/127.0.0.1:{port}"]) as opened:
            node = OtherNode(opened, DOMAIN)
            assert wait_for(lambda: len(node.topics()) == 6)
            for topic, row in node.topics().items():
                assert row["node_name"] == "xrl"
                name = row["dds_type"].replace("::dds_::", "/").replace("::", "/").rstrip("_")
                node.subscribe(topic, name, late=topic == "/robot_description")
            assert wait_for(lambda: len(node.received) == 6)
            assert wait_for(lambda: len(node.received["/joint_states"]) > 100)
            joints = node.received["/joint_states"][-1]
            assert tuple(joints.name) == JOINTS
            assert len(set(joints.position)) == len(JOINTS)
            assert node.received["/robot_description"][0].data.startswith("<robot")
            numbers = [row.sequence_id for row in node.attachments["/joint_states"]]
            assert numbers == sorted(set(numbers)), "each once, in order"
            assert wait_for(lambda: _says(node, "knee_left", "TRACK"))
            assert _says(node, "planner", "LEADING")

            found = xrl("ros2", "check", *asked, "--wait", "30")
            assert found.returncode == 0, found.stdout
            assert "12 of 12 joints" in found.stdout

            def asks() -> bool:
                node.publish("/xrl/intent", "std_msgs/msg/Float64", data=30.0)
                rows = {row.name: row for row in node.received["/diagnostics"][-1].status}
                given = {pair.key: pair.value for pair in rows["xrl: planner"].values}
                return float(given.get("assist, N", 0.0)) > 20.0

            assert wait_for(asks), "the planner gives the assist that is asked for"
            node.publish("/xrl/estop", "std_msgs/msg/Bool", data=False)
            node.publish("/xrl/estop", "std_msgs/msg/Bool", data=True)
            assert wait_for(lambda: all(
                _says(node, name, Mode.DAMP.name)
                for name in MODULES
            ))  # fmt: skip
    finally:
        down = xrl("down", run_dir=run_dir)
    assert down.returncode == 0, down.stderr


def _says(node: OtherNode, name: str, word: str) -> bool:
    rows = {row.name: row.message for row in node.received["/diagnostics"][-1].status}
    return rows[f"xrl: {name}"].startswith(word)
