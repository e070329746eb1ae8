"""When what goes to ROS 2: rates, silence, namespaces."""

from __future__ import annotations

from collections import Counter

import msgspec
import pytest

from services.ros2_gateway.conversions import Conversions
from services.ros2_gateway.gateway import STALE_NS, Gateway, topics_of
from services.ros2_gateway.ros_types import RosTypes
from shared.bus import topics
from shared.bus.messages import JointState
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import JOINTS
from shared.robot.robot_urdf import cross_of
from tests.messages import all_states, planner_status, wrench
from tests.ros2_gateway.others import read

TYPES = RosTypes("jazzy")
T0 = 50 * NS_PER_S
KNOWN = topics_of("")


def made(robot: RobotConfig, *, simulated: bool = True, **rates: float | str) -> Gateway:
    config = msgspec.structs.replace(robot, ros2=msgspec.structs.replace(robot.ros2, **rates))
    return Gateway(config, Conversions(config, TYPES), simulated=simulated)


def feed(gateway: Gateway, now_ns: int, states: dict[str, JointState] | None = None) -> None:
    for module, state in (all_states() if states is None else states).items():
        gateway.receive(topics.JOINT_STATE, module, state, now_ns)
    gateway.receive(topics.PLANNER_STATUS, "", planner_status(), now_ns)
    gateway.receive(topics.WRENCH, "", wrench(), now_ns)


@pytest.mark.parametrize("step_ms", [1, 7, 10, 33])
def test_each_topic_has_its_rate_at_any_cycle_that_is_fast_enough(
    robot: RobotConfig, step_ms: int
) -> None:
    gateway = made(
        robot, joint_states_hz=30.0, tf_hz=10.0, wrench_hz=30.0, diagnostics_hz=1.0, clock_hz=20.0
    )
    counts: Counter[str] = Counter()
    for ms in range(0, 10_000, step_ms):
        now_ns = T0 + ms * NS_PER_MS
        feed(gateway, now_ns)
        counts.update(outgoing.topic.name for outgoing in gateway.due(now_ns, now_ns))
    wanted = {
        "/joint_states": 300, "/tf": 100, "/harness/wrench": 300, "/diagnostics": 10, "/clock": 200,
    }  # fmt: skip
    assert set(counts) == set(wanted)
    for name, count in wanted.items():
        assert counts[name] == pytest.approx(count, abs=2), name


def test_after_a_pause_nothing_is_made_up_for(robot: RobotConfig) -> None:
    gateway = made(robot)
    feed(gateway, T0)
    gateway.due(T0, T0)
    later = T0 + 60 * NS_PER_S
    feed(gateway, later)
    names = [outgoing.topic.name for outgoing in gateway.due(later, later)]
    assert len(names) == len(set(names))
    assert gateway.due(later, later) == []


def test_what_has_no_rate_is_neither_shown_nor_sent(robot: RobotConfig) -> None:
    gateway = made(robot, tf_hz=0.0, simulated=False)
    names = {topic.name for topic in gateway.sent_topics}
    assert names == {"/joint_states", "/harness/wrench", "/diagnostics", "/robot_description"}
    feed(gateway, T0)
    assert {outgoing.topic for outgoing in gateway.due(T0, T0)} <= set(gateway.sent_topics)


@pytest.mark.parametrize(("age_ns", "shown"), [(STALE_NS, True), (STALE_NS + 1, False)])
def test_history_is_not_repeated(robot: RobotConfig, age_ns: int, shown: bool) -> None:
    gateway = made(robot)
    feed(gateway, T0)
    found = {outgoing.topic: outgoing.payload for outgoing in gateway.due(T0 + age_ns, T0)}
    for topic in (KNOWN.joint_states, KNOWN.tf, KNOWN.wrench):
        assert (topic in found) is shown
    rows = {row.name: row for row in read(KNOWN.diagnostics.type, found[KNOWN.diagnostics]).status}
    silent = {name for name, row in rows.items() if row.message.startswith("silent")}
    assert len(silent) == (0 if shown else 8), "six modules, planner and harness"


def test_a_silent_module_ends_the_torso_and_its_own_joints_only_and_none_is_made_up(
    robot: RobotConfig,
) -> None:
    gateway = made(robot)
    states = all_states()
    feed(gateway, T0)
    later = T0 + 2 * STALE_NS
    del states["knee_left"]
    feed(gateway, later, states)
    found = {outgoing.topic: outgoing.payload for outgoing in gateway.due(later, later)}
    joints = read(KNOWN.joint_states.type, found[KNOWN.joint_states])
    assert set(JOINTS) - set(joints.name) == {"knee_left_phi", "knee_left_theta"}
    assert len(joints.position) == len(joints.effort) == len(joints.name) == 10
    children = {row.child_frame_id for row in read(KNOWN.tf.type, found[KNOWN.tf]).transforms}
    assert children & {"torso", "knee_left", cross_of("knee_left")} == set()
    assert "knee_right" in children


def test_a_wrench_that_is_not_valid_is_not_sent(robot: RobotConfig) -> None:
    gateway = made(robot)
    gateway.receive(topics.WRENCH, "", wrench(valid=False), T0)
    assert KNOWN.wrench not in {outgoing.topic for outgoing in gateway.due(T0, T0)}


def test_a_namespace_is_before_all_but_what_ros_2_has_at_the_root(robot: RobotConfig) -> None:
    gateway = made(robot, namespace="lab/legs")
    assert {topic.name for topic in gateway.sent_topics} == {
        "/lab/legs/joint_states", "/tf", "/lab/legs/harness/wrench", "/diagnostics", "/clock",
        "/lab/legs/robot_description",
    }  # fmt: skip


def test_the_description_is_the_urdf_and_is_kept_for_who_comes_later(robot: RobotConfig) -> None:
    topic, payload = made(robot).description()
    assert topic.qos.transient_local
    assert read(topic.type, payload).data.startswith('<robot name="xrl">')
