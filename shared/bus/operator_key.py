"""Whether this host may act on a robot, and not only look."""

from __future__ import annotations

from shared.bus import topics
from shared.bus.credentials import read_credentials
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError


def require_operator(robot: RobotConfig, process: str) -> None:
    """Make sure that the modules heed what this host sends.

    Args:
        robot: its `bus.security`; only `mtls` tells who sends.
        process: name of the tool on the bus.

    Raises:
        BusError: this host has no key.
        FleetError: it has another key than an operator's.
    """
    if robot.bus.security.mode != "mtls":
        return
    name = read_credentials(robot, process).name
    if name != topics.OPERATOR:
        raise FleetError(f"this host has the key of a {name}; to act takes an operator's")
