"""What ROS 2 sees of the robot: router, node, topics, and one message of each that is steady."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, NamedTuple

from services.ros2_gateway.gateway import RosTopics, topics_of
from services.ros2_gateway.rmw import RosTopic, SeenEndpoint
from services.ros2_gateway.ros_session import NODE, RosSession
from services.ros2_gateway.ros_types import RosTypes
from shared.config.robot_config import RobotConfig
from shared.exceptions import BusError
from shared.joints import JOINTS

LOOK_S: Final = 0.1
LISTEN_S: Final = 2.0
"""Long enough for a message of `/diagnostics`."""


class CheckRow(NamedTuple):
    """One finding."""

    good: bool
    what: str
    found: str
    fix: str = ""
    """What to do if it is not good."""


def check(robot: RobotConfig, domain: int, wait_s: float) -> list[CheckRow]:
    """Look at the network as a node of it."""
    ros2, types = robot.ros2, RosTypes(robot.ros2.distribution)
    ros = _opened(ros2.router, domain, types, wait_s)
    if ros is None:
        fix = "start it where ROS 2 is: ros2 run rmw_zenoh_cpp rmw_zenohd; or correct ros2.router"
        return [CheckRow(False, f"router {ros2.router}", "does not answer", fix)]
    with ros:
        rows = [CheckRow(True, f"router {ros2.router}", "answers")]
        name = f"/{ros2.namespace}/{NODE}" if ros2.namespace else f"/{NODE}"
        seen: list[SeenEndpoint] = []

        def look() -> bool:
            seen[:] = ros.graph()
            return any(one.kind == "NN" and one.node == name for one in seen)

        if not _wait(look, wait_s):
            others = _nodes(seen)
            fix = f"start it: xrl up --ros2 --domain {domain}; it may be in another domain"
            return [*rows, CheckRow(False, f"node {name}", f"not among: {others}", fix)]
        rows.append(CheckRow(True, f"node {name}", "in the graph"))
        known = topics_of(ros2.namespace)
        shown = [topic for topic in known if _is_shown(topic, seen, name, types)]
        rows += [
            _topic_row(topic, seen, name, types)
            for topic in known
            if _has_rate(topic, known, robot)
        ]
        steady = [topic for topic in shown if topic != known.description]
        slowest_hz = ros2.diagnostics_hz or 1.0
        rows += _received(ros, steady, known, slowest_hz)
        rows.append(CheckRow(True, "other nodes", _nodes([s for s in seen if s.node != name])))
        return rows


def _opened(router: str, domain: int, types: RosTypes, wait_s: float) -> RosSession | None:
    """Open a session as soon as the router answers; None: it does not in time."""
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return RosSession(router, domain, types, name="xrl_check")
        except BusError:
            if time.monotonic() > deadline:
                return None
            time.sleep(LOOK_S)


def _has_rate(topic: RosTopic, known: RosTopics, robot: RobotConfig) -> bool:
    """Return True for a topic that the robot file wants; the clock is a simulated robot's."""
    ros2 = robot.ros2
    rates = {
        known.joint_states: ros2.joint_states_hz, known.tf: ros2.tf_hz,
        known.wrench: ros2.wrench_hz, known.diagnostics: ros2.diagnostics_hz, known.clock: 0.0,
    }  # fmt: skip
    return rates.get(topic, 1.0) > 0.0


def _is_shown(topic: RosTopic, seen: list[SeenEndpoint], node: str, types: RosTypes) -> bool:
    return any(
        one.kind == "MP" and one.node == node and one.topic == topic.name
        and one.type_hash == types.hash(topic.type)
        for one in seen
    )  # fmt: skip


def _topic_row(topic: RosTopic, seen: list[SeenEndpoint], node: str, types: RosTypes) -> CheckRow:
    if _is_shown(topic, seen, node, types):
        return CheckRow(True, topic.name, topic.type)
    others = [one for one in seen if one.kind == "MP" and one.topic == topic.name]
    found = f"with another type, {others[0].type}" if others else "not in the graph"
    return CheckRow(
        False, topic.name, found, "the same distribution on both sides: ros2.distribution"
    )


def _received(
    ros: RosSession, topics: list[RosTopic], known: RosTopics, slowest_hz: float
) -> list[CheckRow]:
    """Receive long enough for the slowest; return a row for each topic."""
    listen_s = max(LISTEN_S, 1.5 / slowest_hz)
    ros.subscribe(topics)
    counts = dict.fromkeys(topics, 0)
    joints: list[str] = []
    began = time.monotonic()
    while time.monotonic() - began < listen_s:
        for topic, message in ros.take():
            counts[topic] += message is not None
            if topic == known.joint_states and message is not None:
                joints = list(message.name)
        time.sleep(LOOK_S / 4)
    rows = []
    for topic, count in counts.items():
        found = f"{count} messages in {listen_s:.1f} s"
        if topic == known.joint_states:
            found += f", {len(joints)} of {len(JOINTS)} joints"
        good = count > 0 and (topic != known.joint_states or len(joints) == len(JOINTS))
        fix = "the gateway or a service is silent: xrl status"
        rows.append(CheckRow(good or topic == known.wrench, f"{topic.name}, received", found, fix))
    return rows


def _nodes(seen: list[SeenEndpoint]) -> str:
    return ", ".join(sorted({one.node for one in seen if one.kind == "NN"})) or "none"


def _wait(condition: Callable[[], bool], wait_s: float) -> bool:
    deadline = time.monotonic() + wait_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(LOOK_S)
    return True
