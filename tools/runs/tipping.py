"""Whether a robot that has not fallen yet is about to."""

from __future__ import annotations

from typing import Final

from shared.config import RobotConfig
from shared.messages import SimTruth

TIPPING_RAD: Final = 0.05
"""A sole tilted more than this at the end does not lie down again by itself."""


def is_tipping(row: SimTruth, robot: RobotConfig) -> bool:
    """Return True if the robot is beyond what it can come back from."""
    (x, y), geometry = row.over, robot.geometry
    return (
        abs(x) > geometry.l_foot / 2
        or abs(y) > (geometry.w_base + geometry.w_foot) / 2
        or max(row.foot_right_tilt, row.foot_left_tilt) > TIPPING_RAD
    )
