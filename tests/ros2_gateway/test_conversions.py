"""Messages, keys, tokens and hashes against other implementations of ROS 2's formats."""

from __future__ import annotations

import argparse
from itertools import product

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from zenoh_ros2_sdk import attachment as other_attachment
from zenoh_ros2_sdk import keyexpr as other_keys
from zenoh_ros2_sdk.discovery import _parse_liveliness_keyexpr as other_read
from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
from zenoh_ros2_sdk.utils import ros2_to_dds_type

from services.ros2_gateway import conversions, rmw
from services.ros2_gateway.conversions import Conversions, RosTypes
from services.ros2_gateway.rmw import Qos, RosNode, RosTopic
from shared.bus.messages import Cause, DriveStatus, Mode, PlannerMode, Trip
from shared.config.robot_config import RobotConfig
from shared.joints import JOINTS, MODULES
from shared.robot import frames
from shared.robot.frames import Quaternion
from tests.messages import all_states, joint_state, planner_status, wrench
from tests.ros2_gateway.others import TYPES, read

NS = 1_700_000_000_123_456_789


@pytest.fixture(scope="module")
def convert(robot: RobotConfig) -> Conversions:
    return Conversions(robot, RosTypes("jazzy"))


def test_joint_states_have_name_angle_rate_and_torque_of_every_joint(convert: Conversions) -> None:
    states = all_states()
    message = read(conversions.JOINT_STATE, convert.joint_states(NS, states))
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert tuple(message.name) == JOINTS
    for part, values in (("q", message.position), ("v", message.velocity), ("tau", message.effort)):
        assert list(values) == [x for name in MODULES for x in getattr(states[name], part)]


def test_the_transforms_carry_every_frame_to_where_it_is(
    convert: Conversions, robot: RobotConfig
) -> None:
    states, status = all_states(), planner_status(stance=(0.02, 0.0, 0.0, 0.0, 0.0, 0.05))
    rows = read(conversions.TRANSFORMS, convert.transforms(NS, states, status)).transforms
    assert {row.header.stamp.nanosec for row in rows} == {123_456_789}
    q = [angle for name in MODULES for angle in states[name].q]
    position, rotation = frames.torso_pose(robot.geometry, q, status.stance)
    world = chain([(row.header.frame_id, row.child_frame_id, *pose(row)) for row in rows])
    wanted = chain([("world", "torso", position, rotation), *frames.body_frames(robot.geometry, q)])
    for name, (origin, turned) in wanted.items():
        np.testing.assert_allclose(world[name][0], origin, atol=1e-12)
        assert abs(np.dot(world[name][1], turned)) == pytest.approx(1.0, abs=1e-12)
    assert world["com"][0] == status.p[:3]


def pose(row: object) -> tuple[tuple[float, float, float], Quaternion]:
    """Return position and rotation of a TransformStamped."""
    t, r = row.transform.translation, row.transform.rotation  # type: ignore[attr-defined]
    return (t.x, t.y, t.z), (r.x, r.y, r.z, r.w)


def chain(rows: list[tuple[str, str, tuple[float, float, float], Quaternion]]) -> dict[str, tuple]:  # type: ignore[type-arg]
    """Return every frame in the world."""
    found = {"world": (frames.ORIGIN, frames.UPRIGHT)}
    waiting = list(rows)
    while waiting:
        parent, child, position, rotation = waiting.pop(0)
        if parent not in found:
            waiting.append((parent, child, position, rotation))
            continue
        origin, turned = found[parent]
        x, y, z = frames.rotated(turned, position)
        place = (origin[0] + x, origin[1] + y, origin[2] + z)
        found[child] = (place, frames.product(turned, rotation))
    return found


def test_the_wrench_the_text_and_the_clock_are_as_sent(convert: Conversions) -> None:
    message = read(conversions.WRENCH, convert.wrench(NS, wrench()))
    force, torque = message.wrench.force, message.wrench.torque
    assert (force.x, force.y, force.z) == (1.0, -2.0, 30.0)
    assert (torque.x, torque.y, torque.z) == (0.1, 0.2, 0.3)
    assert message.header.frame_id == "harness"
    assert read(conversions.TEXT, convert.text("<robot ä/>")).data == "<robot ä/>"
    clock = read(conversions.CLOCK, convert.clock(NS)).clock
    assert (clock.sec, clock.nanosec) == (1_700_000_000, 123_456_789)


@pytest.mark.parametrize(("mode", "cause"), list(product(Mode, Cause)))
def test_every_mode_and_cause_has_its_level_and_a_fault_its_way_out(
    convert: Conversions, mode: Mode, cause: Cause
) -> None:
    states = {"knee_left": joint_state(mode=int(mode), cause=int(cause))}
    payload = convert.diagnostics(NS, states, planner_status(), wrench(), {})
    rows = {row.name: row for row in read(conversions.DIAGNOSTICS, payload).status}
    knee = rows["xrl: knee_left"]
    level = {Mode.TRACK: 0, Mode.HOLD: 1, Mode.DISARMED: 1, Mode.DAMP: 2, Mode.FAULT: 2}[mode]
    assert ord(knee.level) if isinstance(knee.level, bytes) else knee.level == level
    assert knee.message.startswith(f"{mode.name}: {cause.name}")
    values = {pair.key: pair.value for pair in knee.values}
    if mode in (Mode.DAMP, Mode.FAULT):
        way_out = "xrl rearm" if mode is Mode.DAMP else "xrl kill knee_left"
        assert way_out in values["way out"]
    silent = rows["xrl: knee_right"]
    assert silent.message.startswith("silent")


@pytest.mark.parametrize("mode", PlannerMode)
def test_a_planner_that_does_not_lead_says_why(convert: Conversions, mode: PlannerMode) -> None:
    status = planner_status(mode=int(mode), why="a leg is light", trip=int(Trip.UNLOADED))
    payload = convert.diagnostics(NS, {}, status, None, {"sent": 3})
    rows = {row.name: row for row in read(conversions.DIAGNOSTICS, payload).status}
    assert "a leg is light: " in rows["xrl: planner"].message
    assert rows["xrl: harness"].message == "silent"
    assert [pair.value for pair in rows["xrl: ros2_gateway"].values] == ["3"]


def test_in_a_namespace_every_frame_but_the_world_has_its_name(robot: RobotConfig) -> None:
    ros2 = msgspec.structs.replace(robot.ros2, namespace="lab/legs")
    named = Conversions(msgspec.structs.replace(robot, ros2=ros2), RosTypes("jazzy"))
    rows = read(conversions.TRANSFORMS, named.transforms(NS, all_states(), planner_status()))
    names = {name for row in rows.transforms for name in (row.header.frame_id, row.child_frame_id)}
    assert {name for name in names if not name.startswith("lab/legs/")} == {"world"}
    assert (
        read(conversions.WRENCH, named.wrench(NS, wrench())).header.frame_id == "lab/legs/harness"
    )


@given(payload=st.binary(max_size=64))
def test_bytes_that_are_no_message_are_none(payload: bytes) -> None:
    found = RosTypes("jazzy").decode("std_msgs/msg/Float64", payload)
    assert found is None or isinstance(found.data, float)


@pytest.mark.parametrize("drive", [DriveStatus.LOST, DriveStatus.UNZEROED])
def test_angles_of_a_drive_that_lost_its_zero_are_not_shown(drive: DriveStatus) -> None:
    assert not conversions.knows_position(joint_state(drive=int(drive)))
    assert conversions.knows_position(joint_state())


@pytest.mark.parametrize(
    ("ns", "sec", "nanosec"),
    [(-1, 0, 0), (4_000_000_000_500_000_000, 2**31 - 1, 0), (1 << 80, 2**31 - 1, 0)],
)
def test_a_time_that_ros_2_cannot_say_becomes_the_nearest_that_it_can(
    convert: Conversions, ns: int, sec: int, nanosec: int
) -> None:
    stamp = read(conversions.JOINT_STATE, convert.joint_states(ns, all_states())).header.stamp
    assert (stamp.sec, stamp.nanosec) == (sec, nanosec)


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
