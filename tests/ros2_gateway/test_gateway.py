"""When what goes to ROS 2, and what ROS 2 may ask for: rates, silence, limits, a stop."""

from __future__ import annotations

import math
from collections import Counter
from itertools import product
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from services.ros2_gateway.conversions import Conversions, RosTypes
from services.ros2_gateway.gateway import STALE_NS, Gateway, topics_of
from services.ros2_gateway.inbound import (
    GIVE_UP_NS,
    REPEAT_NS,
    SOURCE,
    Inbound,
    acceptable,
    inbound_topics,
)
from services.ros2_gateway.loop import PERIOD_NS, GatewayLoop
from services.ros2_gateway.rmw import RosTopic
from services.ros2_gateway.ros_session import RosLink
from shared.bus import topics
from shared.bus.messages import JointState, Mode
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError
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


def test_what_has_no_rate_or_is_not_valid_is_not_sent(robot: RobotConfig) -> None:
    gateway = made(robot, tf_hz=0.0, simulated=False)
    names = {topic.name for topic in gateway.sent_topics}
    assert names == {"/joint_states", "/harness/wrench", "/diagnostics", "/robot_description"}
    feed(gateway, T0)
    assert {outgoing.topic for outgoing in gateway.due(T0, T0)} <= set(gateway.sent_topics)
    gateway = made(robot)
    gateway.receive(topics.WRENCH, "", wrench(valid=False), T0)
    assert KNOWN.wrench not in {outgoing.topic for outgoing in gateway.due(T0, T0)}


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


def test_the_namespace_precedes_topics_and_the_description_is_kept_for_late_nodes(
    robot: RobotConfig,
) -> None:
    gateway = made(robot, namespace="lab/legs")
    assert {topic.name for topic in gateway.sent_topics} == {
        "/lab/legs/joint_states", "/tf", "/lab/legs/harness/wrench", "/diagnostics", "/clock",
        "/lab/legs/robot_description",
    }  # fmt: skip
    topic, payload = made(robot).description()
    assert topic.qos.transient_local
    assert read(topic.type, payload).data.startswith('<robot name="xrl">')


DIAGNOSTICS = topics_of("").diagnostics


class PlayedSession:
    failed = 2

    def __init__(self) -> None:
        self.sent: list[tuple[RosTopic, Any]] = []

    def put(self, topic: RosTopic, payload: bytes, *_: object) -> None:
        self.sent.append((topic, payload))


class PlayedLink:
    session: PlayedSession | None = None


def test_diagnostics_tell_what_the_gateway_has_sent_by_then(robot: RobotConfig) -> None:
    link, session = PlayedLink(), PlayedSession()
    gateway = Gateway(robot, Conversions(robot, RosTypes("jazzy")), simulated=True)
    loop = GatewayLoop(gateway, [], cast("RosLink", link))
    for cycle in range(350):
        link.session = session if cycle >= 50 else None  # the router comes later
        loop.cycle(cycle * PERIOD_NS, NS_PER_S + cycle * PERIOD_NS)
    assert loop.sent == len(session.sent)
    told = 0
    for before, (topic, payload) in enumerate(session.sent):
        if topic == DIAGNOSTICS:
            row = read(topic.type, payload).status[-1]
            values = {pair.key: pair.value for pair in row.values}
            assert row.name == "xrl: ros2_gateway"
            # Asked while the cycle's messages are made: the others of that cycle are not sent yet.
            assert before - len(gateway.sent_topics) < int(values["sent"]) <= before
            assert values["not sent"] == "2"
            told += 1
    assert told >= 2


ESTOP, INTENT = inbound_topics("")


def said(data: object) -> SimpleNamespace:
    return SimpleNamespace(data=data)


def test_an_intent_is_passed_on_once_and_a_namespace_keeps_other_robots_requests_apart(
    robot: RobotConfig,
) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(80.0), T0)
    intent = inbound.intent(T0, 3, None)
    assert intent is not None
    assert (intent.assist_n, intent.seq, intent.source) == (80.0, 3, SOURCE)
    assert inbound.intent(T0, 4, None) is None
    ros2 = msgspec.structs.replace(robot.ros2, namespace="a")
    inbound = Inbound(msgspec.structs.replace(robot, ros2=ros2))
    assert inbound_topics("a").estop.name == "/a/xrl/estop"
    inbound.receive(inbound_topics("a").estop, said(True), T0)
    assert inbound.stop_due(T0, heard(T0, *[Mode.TRACK] * 6), 6)


@pytest.mark.parametrize("past", [-1e-9, math.nan, math.inf, -math.inf, 1e308])
def test_a_force_that_cannot_be_given_is_refused_and_counted(
    robot: RobotConfig, past: float
) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(past), T0)
    inbound.receive(INTENT, None, T0)
    assert inbound.intent(T0, 0, None) is None
    assert inbound.refused == 2


@pytest.mark.parametrize("force", [0.0, 1.0])
def test_the_limits_themselves_are_accepted(robot: RobotConfig, force: float) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(force * robot.assist.force_max), T0)
    assert inbound.intent(T0, 0, None) is not None
    inbound.receive(INTENT, said(math.nextafter(robot.assist.force_max, math.inf)), T0)
    assert inbound.intent(T0, 0, None) is None


@pytest.mark.parametrize(
    ("by", "passes"), [("", True), (SCENARIO, True), (SOURCE, True), ("xrl lead by ann", False)]
)
def test_it_does_not_talk_another_operator_down(robot: RobotConfig, by: str, passes: bool) -> None:
    inbound = Inbound(robot)
    inbound.receive(INTENT, said(50.0), T0)
    found = inbound.intent(T0, 0, planner_status(requested_by=by))
    assert (found is not None) is passes
    assert inbound.refused == (not passes)


def heard(at_ns: int, *modes: Mode) -> list[tuple[int, int]]:
    return [(at_ns, int(mode)) for mode in modes]


def test_only_true_stops_and_a_stop_ignores_what_was_heard_before(robot: RobotConfig) -> None:
    inbound = Inbound(robot)
    tracking = heard(T0, *[Mode.TRACK] * 6)
    inbound.receive(ESTOP, said(False), T0)
    assert not inbound.stop_due(T0, tracking, 6)
    inbound.receive(ESTOP, said(True), T0)
    assert inbound.stop_due(T0, tracking, 6)
    inbound.receive(ESTOP, said(False), T0)
    assert inbound.stop_due(T0 + REPEAT_NS, tracking, 6), "nothing here ends a stop"
    # Its link was cut; it may have armed since.
    inbound = Inbound(robot)
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(True), T0)
    old = heard(T0 - 1, *[Mode.DAMP] * 6)
    assert all(inbound.stop_due(T0 + k * REPEAT_NS, old, 6) for k in range(10))


@pytest.mark.parametrize(("mode", "others"), list(product(Mode, [Mode.DAMP, Mode.TRACK])))
def test_a_stop_is_repeated_until_every_module_has_stopped(
    robot: RobotConfig, mode: Mode, others: Mode
) -> None:
    """One that is DISARMED may arm a moment later: it has not stopped."""
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(True), T0)
    puts = 0
    for k in range(10):
        now = T0 + k * REPEAT_NS
        puts += inbound.stop_due(now, heard(now, mode, *[others] * 5), 6)
    stopped = mode in (Mode.DAMP, Mode.FAULT) and others is Mode.DAMP
    assert puts == (1 if stopped else 10), "once in any case: a module may have been silent"
    assert not inbound.not_stopped


def test_a_module_that_is_silent_has_not_stopped_and_giving_up_is_told(robot: RobotConfig) -> None:
    inbound = Inbound(robot)
    inbound.receive(ESTOP, said(True), T0)
    times = range(T0, T0 + 2 * GIVE_UP_NS, REPEAT_NS)
    puts = [at for at in times if inbound.stop_due(at, heard(at, *[Mode.DAMP] * 5), 6)]
    assert puts[-1] - T0 == GIVE_UP_NS
    assert inbound.not_stopped
    inbound.receive(ESTOP, said(True), T0)
    assert not inbound.not_stopped, "until it is asked for again"


@pytest.mark.parametrize(
    ("words", "names"),
    [("intent", ("intent",)), ("estop", ("estop",)), ("intent,estop", ("estop", "intent"))],
)
def test_what_may_be_accepted(words: str, names: tuple[str, ...]) -> None:
    assert acceptable(words) == names


@pytest.mark.parametrize("words", ["", ",", "all", "estop,command", "ESTOP"])
def test_anything_else_is_one_clear_line(words: str) -> None:
    with pytest.raises(FleetError, match="must be intent, estop or intent,estop"):
        acceptable(words)
