"""Definition of standing: one rule for `demo`, `sim`, `crashtest` and the sweeps."""

from __future__ import annotations

from typing import Final

from shared.bus.messages import SimTruth
from shared.config.robot_config import RobotConfig

SOLE_TILT_MAX: Final = 0.05
"""rad; a sole tilted more than this does not lie down again by itself."""
TURNED_MAX: Final = 0.3
"""rad, roll and yaw of the torso; requests are 0.12 at most."""
PITCH: Final = (-0.5, 1.6)
"""rad: led are 0 to 1.2, a hand of 60 N m moves a torso that holds by 0.3."""


def why_not_standing(row: SimTruth, robot: RobotConfig) -> str:
    """Return why the robot does not stand at a moment, or is about to fall; "": it stands."""
    if row.fallen:
        return "it is down"
    (x, y), geometry = row.over, robot.geometry
    if abs(x) > geometry.l_foot / 2 or abs(y) > (geometry.w_base + geometry.w_foot) / 2:
        return f"its COM is beyond the soles, at {1e3 * x:.0f}, {1e3 * y:.0f} mm"
    tilt = max(row.foot_right_tilt, row.foot_left_tilt)
    if tilt > SOLE_TILT_MAX:
        return f"a sole is up, by {tilt:.2f} rad"
    roll, pitch, yaw = row.angles
    if max(abs(roll), abs(yaw)) > TURNED_MAX or not PITCH[0] <= pitch <= PITCH[1]:
        return f"its torso has turned: roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw:.2f} rad"
    return ""


def is_tipping(row: SimTruth, robot: RobotConfig) -> bool:
    """Return True if the robot does not stand, or cannot recover."""
    return bool(why_not_standing(row, robot))
