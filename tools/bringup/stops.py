"""The mechanism's own ends, for legs that hang: they may rest on a stop beyond the soft limits."""

from __future__ import annotations

from typing import Final

import msgspec

from shared.config.robot_config import RobotConfig
from shared.joints import KINDS
from shared.robot.robot_model import HARD_STOP_MARGIN

ROOM: Final = 0.02
"""rad beyond a stop: zero errors of the encoders, and a stop that gives way."""


def within_stops(robot: RobotConfig) -> RobotConfig:
    """Return the robot with its limits at the mechanism's stops."""
    limits = {}
    for kind in KINDS:
        limit = getattr(robot.limits, kind)
        (a, b), (c, d) = limit.phi, limit.theta
        m = HARD_STOP_MARGIN + ROOM
        limits[kind] = msgspec.structs.replace(limit, phi=(a - m, b + m), theta=(c - m, d + m))
    return msgspec.structs.replace(robot, limits=msgspec.structs.replace(robot.limits, **limits))
