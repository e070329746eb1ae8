"""What ROS 2 sees of the robot: router, node, topics, and one message of each that is steady."""

from __future__ import annotations

import time
from typing import Final, NamedTuple

from services.ros2_gateway.conversions import RosTypes
from services.ros2_gateway.gateway import RosTopics, topics_of
from services.ros2_gateway.rmw import RosTopic, SeenEndpoint
from services.ros2_gateway.ros_session import NODE, RosSession
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
        deadline = time.monotonic() + wait_s
        while name not in (nodes := _nodes(seen := ros.graph())):
            if time.monotonic() > deadline:
                found = f"not among: {', '.join(nodes) or 'none'}"
                fix = f"start it: xrl up --ros2 --domain {domain}; it may be in another domain"
                return [*rows, CheckRow(False, f"node {name}", found, fix)]
            time.sleep(LOOK_S)
        rows.append(CheckRow(True, f"node {name}", "in the graph"))
        known = topics_of(ros2.namespace)
        own = {(one.topic, one.type_hash) for one in seen if one.kind == "MP" and one.node == name}
        shown = [topic for topic in known if (topic.name, types.hash(topic.type)) in own]
        rows += [
            CheckRow(True, topic.name, topic.type) if topic in shown else _missing(topic, seen)
            for topic in known
            if _has_rate(topic, known, robot)
        ]
        steady = [topic for topic in shown if topic != known.description]
        rows += _received(ros, steady, known, ros2.diagnostics_hz or 1.0)
        others = [node for node in nodes if node != name]
        return [*rows, CheckRow(True, "other nodes", ", ".join(others) or "none")]


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


def _missing(topic: RosTopic, seen: list[SeenEndpoint]) -> CheckRow:
    others = [one for one in seen if one.kind == "MP" and one.topic == topic.name]
    found = f"with another type, {others[0].type}" if others else "not in the graph"
    fix = "the same distribution on both sides: ros2.distribution"
    return CheckRow(False, topic.name, found, fix)


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


def _nodes(seen: list[SeenEndpoint]) -> list[str]:
    return sorted({one.node for one in seen if one.kind == "NN"})
