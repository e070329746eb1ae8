"""Keys, tokens and attachments against another implementation of rmw_zenoh's contract."""

from __future__ import annotations

import argparse

import pytest
from hypothesis import given
from hypothesis import strategies as st
from zenoh_ros2_sdk import attachment as other_attachment
from zenoh_ros2_sdk import keyexpr as other_keys
from zenoh_ros2_sdk.discovery import _parse_liveliness_keyexpr as other_read
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
from zenoh_ros2_sdk.utils import ros2_to_dds_type

from services.ros2_gateway import rmw
from services.ros2_gateway.rmw import Qos, RosNode, RosTopic
from services.ros2_gateway.ros_types import RosTypes
from tests.ros2_gateway.others import TYPES

QOS = [Qos(), Qos(reliable=False, depth=1), Qos(transient_local=True, depth=1), Qos(depth=100)]
SESSION = "aac3178e146ba6f1fc6e6a4085e77f21"
HASH = "RIHS01_" + "0123456789abcdef" * 4


@pytest.mark.parametrize("namespace", ["/", "/legs", "/lab/legs"])
@pytest.mark.parametrize("qos", QOS)
@pytest.mark.parametrize("kind", ["MP", "MS"])
def test_a_token_is_what_others_write_and_read(namespace: str, qos: Qos, kind: rmw.Kind) -> None:
    node = RosNode(7, SESSION, namespace, "xrl")
    topic = RosTopic("/legs/joint_states", "sensor_msgs/msg/JointState", qos)
    other = NodeEntity(7, SESSION, 0, "xrl", namespace)
    profile = QosProfile(
        QosReliability.RELIABLE if qos.reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if qos.transient_local else QosDurability.VOLATILE,
        history_depth=qos.depth,
    )
    assert QosProfile.decode(qos.encode()) == profile
    assert rmw.node_token(node) == other_keys.node_liveliness_keyexpr(other)
    token = rmw.endpoint_token(node, 3, kind, topic, HASH)
    endpoint = EndpointEntity(
        other, 3, EntityKind(kind), topic.name, ros2_to_dds_type(topic.type), HASH, profile.encode()
    )
    assert token == other_keys.endpoint_liveliness_keyexpr(endpoint)
    parsed = other_read(token)
    assert parsed is not None
    assert (parsed["node_name"], parsed["qualified_name"]) == ("xrl", topic.name)
    seen = rmw.read_token(token)
    assert seen is not None
    assert (seen.kind, seen.topic, seen.type_hash) == (kind, topic.name, HASH)
    assert seen.node == f"{namespace.rstrip('/')}/xrl"


def test_the_examples_of_its_design_page() -> None:
    node = RosNode(2, SESSION, "/", "listener")
    assert rmw.node_token(node) == f"@ros2_lv/2/{SESSION}/0/0/NN/%/%/listener"
    topic = RosTopic("/chatter", "std_msgs/msg/String")
    key = rmw.topic_key(0, topic, HASH)
    assert key == f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"
    assert key == other_keys.topic_keyexpr(0, "/chatter", ros2_to_dds_type(topic.type), HASH)


@given(number=st.integers(0, 2**63 - 1), ns=st.integers(0, 2**63 - 1), token=st.text())
def test_an_attachment_is_read_back_by_others(number: int, ns: int, token: str) -> None:
    gid = rmw.gid_of(token)
    read = other_attachment.Attachment.from_bytes(rmw.attachment(number, ns, gid))
    assert (read.sequence_id, read.timestamp_ns, read.gid) == (number, ns, gid)


@pytest.mark.parametrize("key", ["", "a/b", "@ros2_lv/0/x/0/0/NN/%/%", "x/0/y/0/0/NN/%/%/z"])
def test_what_is_no_token_is_passed_over(key: str) -> None:
    assert rmw.read_token(key) is None


@pytest.mark.parametrize("distribution", ["jazzy", "kilted", "lyrical"])
@pytest.mark.parametrize(
    "name",
    [
        "sensor_msgs/msg/JointState", "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/WrenchStamped",
        "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/String", "rosgraph_msgs/msg/Clock",
        "std_msgs/msg/Float64", "std_msgs/msg/Bool",
    ],
)  # fmt: skip
def test_type_hashes_are_those_of_another_implementation(distribution: str, name: str) -> None:
    assert RosTypes(distribution).hash(name) == TYPES[name].hash_rihs01()


@pytest.mark.parametrize("text", ["-1", "233", "x", "1.5", ""])
def test_a_domain_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="from 0 to 232"):
        rmw.domain(text)


def test_a_domain_is_a_number_from_0_to_232() -> None:
    assert [rmw.domain(text) for text in ("0", "7", "232")] == [0, 7, 232]
