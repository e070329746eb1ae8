"""What ROS 2 may ask of the robot, where it is let: assist, and the emergency stop. Pure."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any, Final

from services.ros2_gateway.rmw import RosTopic
from shared.bus.messages import Mode, OperatorIntent, PlannerStatus
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import SCENARIO
from shared.exceptions import FleetError

SOURCE: Final = "ros2_gateway"
"""Name of the sender, on the robot's bus."""
INTENT: Final = RosTopic("/xrl/intent", "std_msgs/msg/Float64")
"""Assist, N; to be repeated, as `assist.stale_ms` of the robot file says."""
ESTOP: Final = RosTopic("/xrl/estop", "std_msgs/msg/Bool")
"""True stops every module; nothing here ends a stop."""
ACCEPTABLE: Final = {"intent": INTENT, "estop": ESTOP}
"""By the words of `--accept`."""
STOPPED: Final = (Mode.DAMP, Mode.DISARMED, Mode.FAULT)
REPEAT_NS: Final = 50 * NS_PER_MS
GIVE_UP_NS: Final = 5 * NS_PER_S
"""A stop is repeated until every module has stopped, and for so long at most."""


def acceptable(words: str) -> tuple[str, ...]:
    """Return what `--accept` names, such as `intent,estop`.

    Raises:
        FleetError: it is not a list of `ACCEPTABLE`.
    """
    names = tuple(word for word in words.split(",") if word)
    wrong = [name for name in names if name not in ACCEPTABLE]
    if wrong or not names:
        right = " or ".join([*ACCEPTABLE, ",".join(ACCEPTABLE)])
        raise FleetError(f"--accept {words}: {right} is right")
    return names


class Inbound:
    """Requests from ROS 2, within the robot file's limits.

    Attributes:
        refused: messages that were none, or asked for what cannot be given.
    """

    def __init__(self, config: RobotConfig) -> None:
        """Begin without a request."""
        self._most_n = config.assist.force_max
        self._assist_n: float | None = None
        self._stop_since_ns: int | None = None
        self._next_stop_ns = 0
        self.refused = 0

    def receive(self, topic: RosTopic, message: Any | None, now_ns: int) -> None:
        """Take a message of `/xrl/intent` or `/xrl/estop`; None: it could not be read."""
        if message is None:
            self.refused += 1
        elif topic == ESTOP:
            if message.data and self._stop_since_ns is None:
                self._stop_since_ns = self._next_stop_ns = now_ns
        elif math.isfinite(message.data) and 0.0 <= message.data <= self._most_n:
            self._assist_n = float(message.data)
        else:
            self.refused += 1

    def intent(
        self, now_ns: int, number: int, status: PlannerStatus | None
    ) -> OperatorIntent | None:
        """Return the intent that just came, once; None: there is none, or another leads.

        Args:
            now_ns: the fleet's clock.
            number: of the intents sent so far.
            status: of the planner: whose intent it follows.
        """
        assist_n, self._assist_n = self._assist_n, None
        if assist_n is None:
            return None
        if status is not None and status.requested_by not in ("", SCENARIO, SOURCE):
            self.refused += 1
            return None
        return OperatorIntent(t_ns=now_ns, seq=number, assist_n=assist_n, source=SOURCE)

    def stop_due(self, now_ns: int, modes: Collection[int], of: int) -> bool:
        """Return True if the stop is to be put on the bus now.

        Args:
            now_ns: the fleet's clock.
            modes: of the modules that are not silent.
            of: number of all modules.
        """
        since_ns = self._stop_since_ns
        if since_ns is None:
            return False
        stopped = len(modes) == of and all(mode in STOPPED for mode in modes)
        repeated = now_ns > since_ns
        if (stopped and repeated) or now_ns - since_ns > GIVE_UP_NS:
            self._stop_since_ns = None
            return False
        if now_ns < self._next_stop_ns:
            return False
        self._next_stop_ns = now_ns + REPEAT_NS
        return True
