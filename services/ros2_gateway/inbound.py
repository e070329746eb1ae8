"""Requests from ROS 2 to the robot, if accepted: assist and the emergency stop. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from services.ros2_gateway.rmw import RosTopic
from shared.bus.messages import Mode, OperatorIntent, PlannerStatus
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError

SOURCE: Final = "ros2_gateway"
"""Name of the sender on the robot's bus."""
ACCEPTABLE: Final = ("estop", "intent")
"""Values of `--accept`; the stop is processed first."""
STOPPED: Final = (Mode.DAMP, Mode.FAULT)
REPEAT_NS: Final = 50 * NS_PER_MS
GIVE_UP_NS: Final = 5 * NS_PER_S
"""Maximum time for which a stop is repeated until every module has stopped, ns."""


class _InboundTopics(NamedTuple):
    """Topics of a robot that ROS 2 may publish."""

    estop: RosTopic
    """`std_msgs/msg/Bool`: true stops every module; false does not end a stop."""
    intent: RosTopic
    """`std_msgs/msg/Float64`: assist, N; must be repeated within `assist.stale_ms`."""


def inbound_topics(namespace: str) -> _InboundTopics:
    """Return the inbound topics, in a namespace such as `legs` or without one."""
    below = f"/{namespace}" if namespace else ""
    return _InboundTopics(
        RosTopic(f"{below}/xrl/estop", "std_msgs/msg/Bool"),
        RosTopic(f"{below}/xrl/intent", "std_msgs/msg/Float64"),
    )


def acceptable(words: str) -> tuple[str, ...]:
    """Parse the value of `--accept`, such as `intent,estop`; raise FleetError if it is invalid."""
    names = [word for word in words.split(",") if word]
    if not names or not set(names) <= set(ACCEPTABLE):
        raise FleetError(f"--accept {words}: must be intent, estop or intent,estop")
    return tuple(name for name in ACCEPTABLE if name in names)


class Inbound:
    """Requests from ROS 2, within the robot file's limits."""

    def __init__(self, config: RobotConfig) -> None:
        self._topics = inbound_topics(config.ros2.namespace)
        self._most_n = config.assist.force_max
        self._assist_n: float | None = None
        self._stop_since_ns: int | None = None
        self._next_stop_ns = 0
        self.refused = 0
        """Number of messages that were unreadable or out of range, or came while another operator
        was in control."""
        self.not_stopped = False
        """True if the last stop was given up before every module had stopped."""

    def receive(self, topic: RosTopic, message: Any | None, now_ns: int) -> None:
        """Process a message of one of `inbound_topics`; an undecodable `message` is None."""
        if message is None:
            self.refused += 1
        elif topic == self._topics.estop:
            if message.data and self._stop_since_ns is None:
                self._stop_since_ns = self._next_stop_ns = now_ns
                self.not_stopped = False
        elif math.isfinite(message.data) and 0.0 <= message.data <= self._most_n:
            self._assist_n = float(message.data)
        else:
            self.refused += 1

    def intent(
        self, now_ns: int, number: int, status: PlannerStatus | None
    ) -> OperatorIntent | None:
        """Return a new intent once; None without one, or if another operator is in control.

        `number` becomes its sequence number; `status` shows whose intent the planner follows.
        """
        assist_n, self._assist_n = self._assist_n, None
        if assist_n is None:
            return None
        if status is not None and status.requested_by not in ("", SCENARIO, SOURCE):
            self.refused += 1
            return None
        return OperatorIntent(t_ns=now_ns, seq=number, assist_n=assist_n, source=SOURCE)

    def stop_due(self, now_ns: int, modes: Sequence[tuple[int, int]], of: int) -> bool:
        """Return True if the stop must be published now.

        `modes` are arrival time, ns, and mode of each module's newest state. States older than the
        request do not count, because a module may have been silent since. `of` is the number of
        modules.
        """
        since_ns = self._stop_since_ns
        if since_ns is None:
            return False
        stopped = sum(at_ns > since_ns and mode in STOPPED for at_ns, mode in modes)
        if stopped == of or now_ns - since_ns > GIVE_UP_NS:
            self._stop_since_ns, self.not_stopped = None, stopped < of
            return False
        if now_ns < self._next_stop_ns:
            return False
        self._next_stop_ns = now_ns + REPEAT_NS
        return True
