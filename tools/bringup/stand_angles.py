"""Joint angles of a robot that stands, or hangs, as it stands: for zeroing all at once."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from services.planner.law.kinematics import Kinematics
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import MODULE_INDEX, MODULES
from shared.robot.robot_model import stand_pose
from tools.reach import ReachSolver, describe

HEIGHT_TOLERANCE: Final = 1e-7
"""m of torso height"""
ROUNDS: Final = 20
"""Most rounds of the search for the COM height of a torso height; three are usual."""


class StandAngles(NamedTuple):
    """An upright stand, soles flat, COM over the ankles."""

    q: dict[str, Pair]
    """(phi, theta) of each module, rad."""
    hips_forward: float
    """Position of the hips ahead of the ankles with the COM over the ankles, m."""


def stand_angles(robot: RobotConfig, height: float) -> StandAngles:
    """Return the stand with the torso level and its origin (between the hips) at a height, m."""
    longest = robot.geometry.l1 + robot.geometry.l2
    if not 0.0 < height < longest:
        text = f"--standing {height:g}: the hips are between 0 and {longest:g} m above the ankles"
        in_mm = f"; if these are mm: --standing {height / 1e3:g}" if height > 100.0 else ""
        raise RunError(text + in_mm)
    limits = np.array(robot.joint_limits())
    kinematics = Kinematics(robot)
    ik = ReachSolver(kinematics, limits)
    ik.q[:] = stand_pose(robot, height)
    kinematics.update(ik.q)
    p_ref = np.array([0.0, 0.0, kinematics.p[2], 0.0, 0.0, 0.0])
    slope, before = 1.0, None  # d COM height / d torso height, by the last two rounds
    for _ in range(ROUNDS):
        reach = ik.solve_from_anywhere(p_ref)
        if not reach.converged:
            raise RunError(f"--standing {height:g}: {describe(reach, p_ref, limits)}")
        z, z_com = float(kinematics.r_torso[2]), float(p_ref[2])
        if abs(height - z) <= HEIGHT_TOLERANCE:
            angles = ik.q.reshape(len(MODULES), 2).tolist()
            q = {module: (angles[i][0], angles[i][1]) for module, i in MODULE_INDEX.items()}
            return StandAngles(q, float(kinematics.r_torso[0]))
        if before is not None and z != before[0]:
            slope = (z_com - before[1]) / (z - before[0])
        before = (z, z_com)
        p_ref[2] += slope * (height - z)
    raise RunError(f"--standing {height:g}: no stand found at this height")
