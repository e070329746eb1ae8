"""Loop of the gateway: reads the robot's newest messages and publishes them to ROS 2 when due."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

from services.ros2_gateway.conversions import NOT_STOPPED
from services.ros2_gateway.gateway import Gateway
from services.ros2_gateway.inbound import SOURCE, Inbound
from services.ros2_gateway.rmw import RosTopic
from services.ros2_gateway.ros_session import RosLink
from shared.bus.messages import Estop, JointState, OperatorIntent, PlannerStatus
from shared.bus.pubsub import Latest, Publisher
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS
from shared.joints import N_MODULES

PERIOD_NS: Final = 10 * NS_PER_MS

Input = tuple[Topic, str, "Latest[Any]"]
"""Topic, module or "", subscriber."""


class GatewayLoop:
    """Runs the gateway, one cycle per call."""

    def __init__(self, gateway: Gateway, inputs: Sequence[Input], link: RosLink) -> None:
        self._gateway, self._inputs, self._link = gateway, inputs, link
        gateway.figures = self.figures
        self._inbound: Inbound | None = None
        self._intents: Publisher[OperatorIntent] | None = None
        self._stops: Publisher[Estop] | None = None
        self._modes: dict[str, tuple[int, int]] = {}
        """Arrival time, ns, and mode of each module's newest state."""
        self._status: PlannerStatus | None = None
        self.cycles = 0
        self.sent = 0
        """Number of messages sent to ROS 2."""
        self.passed = 0
        """Number of messages forwarded from ROS 2 to the robot."""

    def accept(
        self, inbound: Inbound, intents: Publisher[OperatorIntent], stops: Publisher[Estop]
    ) -> None:
        """Forward requests from ROS 2 from now on."""
        self._inbound, self._intents, self._stops = inbound, intents, stops

    def cycle(self, now_ns: int, unix_ns: int) -> None:
        """Run one cycle; `unix_ns` is the time `now_ns` in ns since 1970."""
        for topic, module, latest in self._inputs:
            message = latest.take()
            if message is None:
                continue
            self._gateway.receive(topic, module, message, now_ns)
            if isinstance(message, JointState):
                self._modes[module] = now_ns, message.mode
            elif isinstance(message, PlannerStatus):
                self._status = message
        ros = self._link.session
        if self._inbound is not None and ros is not None:
            self._pass_on(self._inbound, ros.take(), now_ns)
        for outgoing in self._gateway.due(now_ns, unix_ns):
            if ros is not None:
                ros.put(*outgoing)
                self.sent += 1
        self.cycles += 1

    def figures(self) -> dict[str, object]:
        """Return the gateway's own figures for `/diagnostics` and the log."""
        ros = self._link.session
        found: dict[str, object] = {"sent": self.sent, "not sent": ros.failed if ros else 0}
        if self._inbound is not None:
            found |= {"passed on": self.passed, "refused": self._inbound.refused}
            if self._inbound.not_stopped:
                found[NOT_STOPPED] = "a module did not stop: cut the power"
        return found

    def _pass_on(
        self, inbound: Inbound, received: Iterable[tuple[RosTopic, Any | None]], now_ns: int
    ) -> None:
        assert self._intents is not None  # noqa: S101 - `accept` sets all three
        assert self._stops is not None  # noqa: S101
        for topic, message in received:
            inbound.receive(topic, message, now_ns)
        intent = inbound.intent(now_ns, self.passed, self._status)
        if intent is not None:
            self._intents.put(intent)
            self.passed += 1
        if inbound.stop_due(now_ns, list(self._modes.values()), N_MODULES):
            self._stops.put(Estop(t_ns=now_ns, seq=self.passed, source=SOURCE))
            self.passed += 1
