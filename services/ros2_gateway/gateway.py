"""Decides which message goes to ROS 2 and when, from the robot's newest messages. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from services.ros2_gateway import conversions
from services.ros2_gateway.conversions import Conversions, knows_position
from services.ros2_gateway.rmw import Qos, RosTopic
from shared.bus import topics
from shared.bus.messages import JointState, Message, PlannerStatus, Wrench
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from shared.robot.robot_urdf import urdf

STALE_NS: Final = 500 * NS_PER_MS
"""Age above which messages are stale, ns: their sender is dead, suspended or cut off."""
INPUTS: Final = (topics.JOINT_STATE, topics.PLANNER_STATUS, topics.WRENCH)
"""Robot topics that the gateway receives."""


class _Outgoing(NamedTuple):
    """A message for ROS 2."""

    topic: RosTopic
    payload: bytes
    """Message in CDR."""


class RosTopics(NamedTuple):
    """The topics of one robot; `/tf`, `/diagnostics` and `/clock` are outside its namespace."""

    joint_states: RosTopic
    tf: RosTopic
    wrench: RosTopic
    diagnostics: RosTopic
    clock: RosTopic
    description: RosTopic


def topics_of(namespace: str) -> RosTopics:
    """Return the topics of a robot in a namespace, such as `legs`, or without one."""
    below = f"/{namespace}" if namespace else ""
    return RosTopics(
        RosTopic(f"{below}/joint_states", conversions.JOINT_STATE),
        RosTopic("/tf", conversions.TRANSFORMS, Qos(depth=100)),
        RosTopic(f"{below}/harness/wrench", conversions.WRENCH),
        RosTopic("/diagnostics", conversions.DIAGNOSTICS),
        RosTopic("/clock", conversions.CLOCK, Qos(reliable=False, depth=1)),
        RosTopic(
            f"{below}/robot_description", conversions.TEXT, Qos(transient_local=True, depth=1)
        ),
    )


class Gateway:
    """Converts the robot's newest messages to ROS 2, at the rates of `config.ros2`.

    Stale data is not repeated: joint states omit a module that is silent or has no valid angles,
    and transforms then omit the torso. For a simulated robot, the gateway also publishes the time.
    """

    def __init__(self, config: RobotConfig, convert: Conversions, *, simulated: bool) -> None:
        self.topics = topics_of(config.ros2.namespace)
        self._convert, self._config = convert, config
        self._newest: dict[tuple[Topic, str], tuple[int, Message]] = {}
        self._next_ns: dict[RosTopic, int] = {}
        rates, known = config.ros2, self.topics
        sends: list[tuple[RosTopic, float, Callable[[int, int], bytes | None]]] = [
            (known.joint_states, rates.joint_states_hz, self._joint_states),
            (known.tf, rates.tf_hz, self._transforms),
            (known.wrench, rates.wrench_hz, self._wrench),
            (known.diagnostics, rates.diagnostics_hz, self._diagnostics),
            (known.clock, rates.clock_hz if simulated else 0.0, lambda _, ns: convert.clock(ns)),
        ]
        self._sends = [
            (topic, round(NS_PER_S / rate_hz), make) for topic, rate_hz, make in sends if rate_hz
        ]
        self.figures: Callable[[], Mapping[str, object]] = dict
        """Called for each `/diagnostics` message; returns the gateway's own figures."""

    @property
    def sent_topics(self) -> list[RosTopic]:
        """Topics that have a rate, and that of the description."""
        return [*(topic for topic, _, _ in self._sends), self.topics.description]

    def description(self) -> _Outgoing:
        """Return the robot's description, to be sent once at the start."""
        return _Outgoing(self.topics.description, self._convert.text(urdf(self._config)))

    def receive(self, topic: Topic, module: str, message: Message, now_ns: int) -> None:
        """Store a message that has arrived from the robot."""
        self._newest[topic, module] = now_ns, message

    def due(self, now_ns: int, unix_ns: int) -> list[_Outgoing]:
        """Return the due messages, with time stamps `unix_ns`; `now_ns` is on `receive`'s clock."""
        found = []
        for topic, period_ns, make in self._sends:
            due_ns = self._next_ns.get(topic, now_ns)
            if now_ns < due_ns:
                continue
            late = (now_ns - due_ns) // period_ns
            self._next_ns[topic] = due_ns + (1 + late) * period_ns
            payload = make(now_ns, unix_ns)
            if payload is not None:
                found.append(_Outgoing(topic, payload))
        return found

    def _at(self, topic: Topic, module: str, now_ns: int) -> Any | None:
        """Return a key's newest message; None if it is missing or stale."""
        arrived_ns, message = self._newest.get((topic, module), (0, None))
        return message if now_ns - arrived_ns <= STALE_NS else None

    def _states(self, now_ns: int) -> dict[str, JointState]:
        found = {name: self._at(topics.JOINT_STATE, name, now_ns) for name in MODULES}
        return {name: state for name, state in found.items() if state is not None}

    def _placed(self, now_ns: int) -> dict[str, JointState]:
        states = self._states(now_ns)
        return {name: state for name, state in states.items() if knows_position(state)}

    def _status(self, now_ns: int) -> PlannerStatus | None:
        return self._at(topics.PLANNER_STATUS, "", now_ns)

    def _joint_states(self, now_ns: int, unix_ns: int) -> bytes | None:
        states = self._placed(now_ns)
        return self._convert.joint_states(unix_ns, states) if states else None

    def _transforms(self, now_ns: int, unix_ns: int) -> bytes | None:
        states = self._placed(now_ns)
        return self._convert.transforms(unix_ns, states, self._status(now_ns)) if states else None

    def _wrench(self, now_ns: int, unix_ns: int) -> bytes | None:
        wrench: Wrench | None = self._at(topics.WRENCH, "", now_ns)
        if wrench is None or not wrench.valid:
            return None
        return self._convert.wrench(unix_ns, wrench)

    def _diagnostics(self, now_ns: int, unix_ns: int) -> bytes:
        return self._convert.diagnostics(
            unix_ns,
            self._states(now_ns),
            self._status(now_ns),
            self._at(topics.WRENCH, "", now_ns),
            self.figures(),
        )
