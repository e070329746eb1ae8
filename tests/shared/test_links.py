"""Who is linked to whom: every publisher to every subscriber, each pair once."""

from __future__ import annotations

from shared.bus import topics
from shared.bus.session import peers_of
from shared.bus.topics import Topic
from shared.config.robot_config import SERVICES
from shared.joints import MODULES

TOOL = topics.OPERATOR

TALK: dict[Topic, tuple[tuple[str, ...], tuple[str, ...]]] = {
    topics.JOINT_STATE: (MODULES, ("planner", "recorder", TOOL)),
    topics.JOINT_COMMAND: (("planner",), (*MODULES, "recorder", TOOL)),
    topics.JOINT_EVENT: (MODULES, ("recorder", TOOL)),
    topics.JOINT_TRACE: (MODULES, ("recorder",)),
    topics.PLANNER_CHECKPOINT: (("planner",), ("recorder",)),
    topics.SIM_STATE: (("simulator",), ("recorder",)),
    topics.WRENCH: (("harness",), ("planner", "recorder", TOOL)),
    topics.ATTITUDE: (("imu",), ("planner", "recorder", TOOL)),
    topics.HARNESS_TARE: ((TOOL,), ("harness", "recorder")),
    topics.PLANNER_STATUS: (("planner",), ("recorder", TOOL)),
    topics.OPERATOR_INTENT: (("simulator", TOOL), ("planner", "simulator", "recorder", TOOL)),
    topics.OPERATOR_HAND: ((TOOL,), ("simulator", "recorder")),
    topics.ESTOP: ((TOOL,), (*MODULES, "recorder")),
    topics.SIM_TRUTH: (("simulator",), ("recorder", TOOL)),
    topics.SIM_CONTROL: ((TOOL,), ("simulator", "recorder")),
    topics.RUN_EVENT: ((TOOL,), ("recorder",)),
    topics.LINK_EVENT: (("network_proxy",), ("recorder",)),
    topics.TOOLS: (("recorder",), (TOOL,)),
}
"""Who puts each topic on the bus, and who takes it, by hand: not from the topic table."""


def linked(one: str, other: str) -> bool:
    return one in peers_of(other) or other in peers_of(one)


def test_every_publisher_has_a_link_to_every_subscriber() -> None:
    assert set(TALK) == set(topics.TOPICS), "each topic has a row in TALK, above"
    for topic, (publishers, subscribers) in TALK.items():
        for publisher in publishers:
            for subscriber in subscribers:
                if publisher != subscriber:
                    assert linked(publisher, subscriber), (topic.name, publisher, subscriber)


def test_each_pair_is_linked_once_and_joint_services_not_to_one_another() -> None:
    for one in SERVICES:
        assert one not in peers_of(one)
        assert len(set(peers_of(one))) == len(peers_of(one))
        for other in SERVICES:
            both = (one in peers_of(other)) + (other in peers_of(one))
            expected = 0 if one == other or {one, other} <= set(MODULES) else 1
            assert both == expected, (one, other)
    assert set(peers_of(TOOL)) == set(SERVICES)
    assert not any(TOOL in peers_of(service) for service in SERVICES)
