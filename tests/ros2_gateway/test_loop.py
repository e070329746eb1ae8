"""The gateway's loop, with a ROS 2 session that the test plays."""

from __future__ import annotations

from typing import Any, cast

from services.ros2_gateway.conversions import Conversions
from services.ros2_gateway.gateway import Gateway, topics_of
from services.ros2_gateway.loop import PERIOD_NS, GatewayLoop
from services.ros2_gateway.rmw import RosTopic
from services.ros2_gateway.ros_session import RosLink
from services.ros2_gateway.ros_types import RosTypes
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from tests.ros2_gateway.others import read

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
