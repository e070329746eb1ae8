"""`xrl ros2 check`: checks the robot's router, node, topics and messages in ROS 2."""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from typing import Annotated, Final, NamedTuple

import msgspec

from services.ros2_gateway import rmw
from services.ros2_gateway.conversions import RosTypes
from services.ros2_gateway.gateway import RosTopics, topics_of
from services.ros2_gateway.rmw import RosTopic, SeenEndpoint
from services.ros2_gateway.ros_session import NODE, RosSession
from shared.config import checks
from shared.config.files import load
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, BusError, RunError
from shared.extras import require
from shared.joints import JOINTS
from tools.flags import Arg, ConfigFlags, Seconds, parsed
from tools.terminal import Console, marked

EXAMPLES: Final = """
xrl up --ros2 && xrl ros2 check
xrl ros2 check --domain 7 --router tcp/192.168.0.2:7447
"""
LOOK_S: Final = 0.1
LISTEN_S: Final = 2.0
"""Minimum time over which messages are counted, s."""


def _domain_here() -> int:
    try:
        return rmw.domain(os.environ.get("ROS_DOMAIN_ID") or "0")
    except argparse.ArgumentTypeError as error:
        raise RunError(f"ROS_DOMAIN_ID: {error}") from None


class CheckFlags(ConfigFlags):
    """ROS 2 network to check."""

    domain: Annotated[int, parsed(rmw.domain, "N")] = dataclasses.field(
        default_factory=_domain_here
    )
    """ROS domain (default: $ROS_DOMAIN_ID, else 0)"""
    router: Annotated[str | None, Arg(metavar="ENDPOINT")] = None
    """endpoint of the router (default: ros2.router of the robot file)"""
    wait: Seconds = 5.0
    """timeout for router, node, and each topic's first message"""


def run(flags: CheckFlags) -> int:
    """Check and print the findings; return 0 if nothing is missing."""
    require("ros2")
    robot = load(flags.config)
    if flags.router is not None:
        ros2 = msgspec.structs.replace(robot.ros2, router=flags.router)
        robot = msgspec.structs.replace(robot, ros2=ros2)
        checks.check("--router", robot)
    rows = look(robot, flags.domain, flags.wait)
    console = Console(highlight=False)
    for row in rows:
        mark = marked("[green]ok[/]") if row.good else marked("[bold red]no[/]")
        console.print(marked("{}  {}: {}", mark, row.what, row.found), soft_wrap=True)
        if not row.good:
            console.print(f"      {row.fix}", soft_wrap=True)
    return 0 if all(row.good for row in rows) else FAULT_EXIT_CODE


class _CheckRow(NamedTuple):
    """One finding."""

    good: bool
    what: str
    found: str
    fix: str = ""
    """Remedy if `good` is False."""


def look(robot: RobotConfig, domain: int, wait_s: float) -> list[_CheckRow]:
    """Check the network as one of its nodes."""
    ros2, types = robot.ros2, RosTypes(robot.ros2.distribution)
    ros = _opened(ros2.router, domain, types, wait_s)
    if ros is None:
        fix = (
            "start it on the ROS 2 host: ros2 run rmw_zenoh_cpp rmw_zenohd; or correct ros2.router"
        )
        return [_CheckRow(False, f"router {ros2.router}", "does not answer", fix)]
    with ros:
        rows = [_CheckRow(True, f"router {ros2.router}", "answers")]
        name = f"/{ros2.namespace}/{NODE}" if ros2.namespace else f"/{NODE}"
        deadline = time.monotonic() + wait_s
        while name not in (nodes := _nodes(seen := ros.graph())):
            if time.monotonic() > deadline:
                found = f"not among the nodes: {', '.join(nodes) or 'none'}"
                fix = f"start it with xrl up --ros2 --domain {domain}, or check its domain"
                return [*rows, _CheckRow(False, f"node {name}", found, fix)]
            time.sleep(LOOK_S)
        rows.append(_CheckRow(True, f"node {name}", "in the graph"))
        known = topics_of(ros2.namespace)
        own = {(one.topic, one.type_hash) for one in seen if one.kind == "MP" and one.node == name}
        shown = [topic for topic in known if (topic.name, types.hash(topic.type)) in own]
        rows += [
            _CheckRow(True, topic.name, topic.type) if topic in shown else _missing(topic, seen)
            for topic in known
            if _has_rate(topic, known, robot)
        ]
        steady = [topic for topic in shown if topic != known.description]
        rows += _received(ros, steady, known, max(wait_s, 3.0 / (ros2.diagnostics_hz or 1.0)))
        others = [node for node in nodes if node != name]
        return [*rows, _CheckRow(True, "other nodes", ", ".join(others) or "none")]


def _opened(router: str, domain: int, types: RosTypes, wait_s: float) -> RosSession | None:
    """Open a session as soon as the router answers; return None if it does not in time."""
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return RosSession(router, domain, types, name="xrl_check")
        except BusError:
            if time.monotonic() > deadline:
                return None
            time.sleep(LOOK_S)


def _has_rate(topic: RosTopic, known: RosTopics, robot: RobotConfig) -> bool:
    """Return True if a topic must be present: the robot file enables it; the clock is optional."""
    ros2 = robot.ros2
    rates = {
        known.joint_states: ros2.joint_states_hz, known.tf: ros2.tf_hz,
        known.wrench: ros2.wrench_hz, known.diagnostics: ros2.diagnostics_hz, known.clock: 0.0,
    }  # fmt: skip
    return rates.get(topic, 1.0) > 0.0


def _missing(topic: RosTopic, seen: list[SeenEndpoint]) -> _CheckRow:
    others = [one for one in seen if one.kind == "MP" and one.topic == topic.name]
    found = f"with another type, {others[0].type}" if others else "not in the graph"
    fix = "use the same distribution on both sides: ros2.distribution"
    return _CheckRow(False, topic.name, found, fix)


def _received(
    ros: RosSession, topics: list[RosTopic], known: RosTopics, wait_s: float
) -> list[_CheckRow]:
    """Count each topic's messages; wait up to `wait_s` for a slow topic's first message."""
    ros.subscribe(topics)
    counts = dict.fromkeys(topics, 0)
    joints: list[str] = []
    began = time.monotonic()
    while (heard_s := time.monotonic() - began) < LISTEN_S or (
        heard_s < wait_s and not all(counts.values())
    ):
        for topic, message in ros.take():
            counts[topic] += message is not None
            if topic == known.joint_states and message is not None:
                joints = list(message.name)
        time.sleep(LOOK_S / 4)
    rows = []
    for topic, count in counts.items():
        found = f"{count} messages in {heard_s:.1f} s"
        if topic == known.joint_states:
            found += f", {len(joints)} of {len(JOINTS)} joints"
        good = count > 0 and (topic != known.joint_states or len(joints) == len(JOINTS))
        fix = "the gateway or a service is silent: see xrl status"
        rows.append(_CheckRow(good or topic == known.wrench, f"{topic.name}, received", found, fix))
    return rows


def _nodes(seen: list[SeenEndpoint]) -> list[str]:
    return sorted({one.node for one in seen if one.kind == "NN"})
