"""A leg that hangs: a joint's inertia and gravity by the robot file, its place to move. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.joint.differential import limits_of
from services.planner.law.model import HangingLegs
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from shared.joints import MODULE_INDEX, MODULES, N_JOINTS, side_of

INSIDE: Final = 0.12
"""rad inside its limits that a joint is led to: room for the motion."""
HEAVY: Final = 1.0
"""kg m^2; with more on it a joint that is shaken quickly shakes the hoist."""
RESTS_FROM: Final = 15.0
"""N m on a limp hip; 9 where the emulated robot hangs free, 22 where its soles are on the floor."""
BIAS_TORQUE: Final = 1.3
"""Times what gravity takes at the bias, by the robot file."""


def leg_of(*modules: str) -> tuple[str, ...]:
    """Return all modules of these modules' legs."""
    sides = {side_of(module) for module in modules}
    return tuple(name for name in MODULES if side_of(name) in sides)


def why_resting(robot: RobotConfig, q: Mapping[str, Pair]) -> str:
    """Return why a leg does not hang free at q, rad; "" if it may.

    A limp joint that gravity would move rests on something.

    Args:
        robot: its file.
        q: of the leg's three modules.
    """
    tau = HangingLegs(robot).torque(_angles(q))
    for name, (_, theta) in q.items():
        torque = tau[2 * MODULE_INDEX[name] + 1]
        if name.startswith("hip") and abs(torque) > RESTS_FROM:
            return (
                f"{name} is limp at theta {theta:.2f} rad, where its leg weighs {abs(torque):.0f} "
                "N m on it: it rests on something"
            )
    return ""


class HangingJoint(NamedTuple):
    """A joint of a leg that hangs, by the robot file."""

    inertia: float
    """Inertia of what hangs on it, without its rotor, kg m^2."""
    gravity: float
    """Stiffness that gravity gives it, N m/rad."""
    bias: Pair
    """How far its module must be led to be well inside its limits, (phi, theta), rad."""

    @property
    def held_torque(self) -> float:
        """What holds the leg at its bias, N m."""
        return BIAS_TORQUE * self.gravity * sum(map(abs, self.bias))


def hanging_joint(
    robot: RobotConfig, q: Mapping[str, Pair], module: str, axis: int
) -> HangingJoint:
    """Return what the robot file says of a joint of a leg that hangs at q, rad."""
    legs, at = HangingLegs(robot), _angles(q)
    joint, by = 2 * MODULE_INDEX[module] + axis, np.zeros(N_JOINTS)
    by[joint] = 1e-4
    slope = (legs.torque(at + by)[joint] - legs.torque(at - by)[joint]) / 2e-4
    limits = limits_of(robot, module)
    phi, theta = (
        min(max(value, low + INSIDE), high - INSIDE) - value
        for value, (low, high) in zip(q[module], (limits.phi, limits.theta), strict=True)
    )
    return HangingJoint(float(legs.inertia(at)[joint]), abs(float(slope)), (phi, theta))


def _angles(q: Mapping[str, Pair]) -> NDArray[np.float64]:
    """Return joint angles (12,), rad, 0 where a module is not there."""
    at = np.zeros(N_JOINTS)
    for name, pair in q.items():
        index = 2 * MODULE_INDEX[name]
        at[index : index + 2] = pair
    return at
