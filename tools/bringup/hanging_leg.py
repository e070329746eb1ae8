"""Model of a hanging leg: inertia and gravity of its joints, and poses that gravity explains. Pure.

The model has the two equal masses of the robot file, at knee and ankle. The hip's module is on the
torso, and an ankle's mass lies on its axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.joint.differential import limits_of
from services.planner.law.model import HangingLegs
from shared.arrays import Array
from shared.bus.messages import Pair, Vector3
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import MODULE_INDEX, MODULES, N_JOINTS, side_of

INSIDE: Final = 0.12
"""Minimum distance of a joint from its limits before a motion, rad."""
HEAVY: Final = 1.0
"""Inertia above which fast motion of a joint shakes the hoist, kg m^2."""
RESTS_FROM: Final = 15.0
"""Maximum torque on a limp hip whose leg hangs free, N m. The emulated robot has 9, and 22 with its
soles on the floor."""
BIAS_TORQUE: Final = 1.3
"""Safety factor on the gravity torque at the bias, as computed from the robot file."""

FRICTION: Final = 1.0
"""Maximum dry friction and cogging that hold a joint off its equilibrium, N m; the simulated robot
has 0.5. The thigh is short, so 1 N m at hip and knee holds a knee 0.055 rad off."""
KNEE_ERROR: Final = 0.03
"""Maximum error of a hanging knee's angle as computed from the robot file, rad, if
a module is 8 mm off."""
HIP_ERROR: Final = 0.02
"""Maximum error of the direction to a leg's centre of mass as computed from the robot file, rad."""
BEYOND: Final = 0.25
"""Maximum distance of a joint beyond its limits, rad; the mechanical stops are outside these."""
STOP_FROM: Final = 0.05
"""Distance from a limit, rad, within which a joint may rest on a mechanical stop."""
TILT_MAX: Final = 0.35
"""Maximum tilt of a hanging torso, rad."""
FOLDED: Final = 1.0
"""Maximum angle of a hanging leg's thigh from the vertical, rad."""
SWUNG: Final = 0.04
"""Minimum swing of a joint to either side of its rest position, rad: beyond what friction holds."""


def leg_of(*modules: str) -> tuple[str, ...]:
    """Return all modules of the legs that contain these modules."""
    sides = {side_of(module) for module in modules}
    return tuple(name for name in MODULES if side_of(name) in sides)


def why_resting(robot: RobotConfig, q: Mapping[str, Pair]) -> str:
    """Return why a leg cannot hang free at q, rad, or "".

    A limp hip that gravity would move rests on something; other joints are not judged.

    Args:
        robot: robot file.
        q: angles of the leg's three modules.
    """
    tau = HangingLegs(robot).torque(_angles(q))
    for name, (_, theta) in q.items():
        torque = tau[2 * MODULE_INDEX[name] + 1]
        if name.startswith("hip") and abs(torque) > RESTS_FROM:
            return (
                f"{name} is limp at theta {theta:.2f} rad, where its leg loads it with "
                f"{abs(torque):.0f} N m: the leg rests on something"
            )
    return ""


class HangingJoint(NamedTuple):
    """Properties of a joint of a hanging leg, by the robot file."""

    inertia: float
    """Inertia of the parts below the joint, without its rotor, kg m^2."""
    gravity: float
    """Stiffness from gravity, N m/rad."""
    bias: Pair
    """Offset that moves its module inside the limits by `INSIDE`, (phi, theta), rad."""

    @property
    def held_torque(self) -> float:
        """Torque that holds the leg at its bias, N m."""
        return BIAS_TORQUE * self.gravity * sum(map(abs, self.bias))


def hanging_joint(
    robot: RobotConfig, q: Mapping[str, Pair], module: str, axis: int
) -> HangingJoint:
    """Return the properties of a joint of a leg that hangs at q, rad, by the robot file."""
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
    """Return joint angles (12,), rad, with 0 for missing modules."""
    at = np.zeros(N_JOINTS)
    for name, pair in q.items():
        index = 2 * MODULE_INDEX[name]
        at[index : index + 2] = pair
    return at


class Upright(NamedTuple):
    """Measured direction of up."""

    up: Vector3
    within: float
    """Maximum error, rad; inf if the direction is unknown."""

    @property
    def is_known(self) -> bool:
        """True if the direction is known."""
        return math.isfinite(self.within)


def leg_scores(robot: RobotConfig, q_knee: Array, q_hip: Array, upright: Upright) -> Array:
    """Return scores (n, m) of a leg's poses; gravity explains a pose with a score of at most 1.

    Args:
        robot: masses, lengths and limits.
        q_knee: (n, 2) phi and theta of its knee, rad.
        q_hip: (m, 2) phi and theta of its hip, rad.
        upright: direction of up; if unknown, it is assumed within `TILT_MAX` of the torso's z.
    """
    allowed = TILT_MAX
    if upright.is_known:
        allowed = HIP_ERROR + FRICTION / _weight(robot) + upright.within
    up = np.array(upright.up if upright.is_known else (0.0, 0.0, 1.0))
    hips = angle(implied_up(robot, q_knee, q_hip), up) / allowed
    return np.maximum(hips, _knee_scores(robot, q_knee)[:, None])


def implied_up(robot: RobotConfig, q_knee: Array, q_hip: Array) -> Array:
    """Return up in torso axes (n, m, 3), assuming that the leg's COM is below its hip."""
    up: Array = -np.einsum("hij,kj->khi", rotations(q_hip), _leg_down(robot, q_knee))
    return up


def angle(vectors: Array, other: Array) -> Array:
    """Return the angles between unit vectors (..., 3) and another one (3,), rad."""
    across = np.linalg.norm(np.cross(vectors, other), axis=-1)
    return np.asarray(np.arctan2(across, vectors @ other), float)


def not_swung(swing: tuple[Pair, Pair], *, knee: bool) -> str:
    """Return a direction in which a joint swung too little, or "". A knee may hang on its stop."""
    (phi_low, theta_low), (phi_high, theta_high) = swing
    sides = {
        "phi, to its left": phi_low <= -SWUNG,
        "phi, to its right": phi_high >= SWUNG,
        "theta, backwards": theta_low <= -SWUNG,
        "theta, forwards": knee or theta_high >= SWUNG,
    }
    return next((side for side, swung in sides.items() if not swung), "")


def rotations(q: Array) -> Array:
    """Return Ry(-theta) Rx(-phi) (n, 3, 3), which rotates from a link's axes to its parent's."""
    phi, theta = q[:, 0], q[:, 1]
    c, s, cp, sp = np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi)
    zero = np.zeros(len(q))
    rows = [[c, s * sp, -s * cp], [zero, cp, sp], [s, -c * sp, c * cp]]
    return np.moveaxis(np.array(rows), 2, 0)


def _knee_scores(robot: RobotConfig, q: Array) -> Array:
    """Score knees (n, 2) by the torque that friction must hold; up to 1 is plausible.

    Stops hold any torque. The score is inf if the thigh is too far from the vertical. The thigh
    swings as the knee bends, so the shin moves by only a third of the knee's angle.
    """
    down = _leg_down(robot, q)
    l1, l2 = robot.geometry.l1, robot.geometry.l2
    foot = -rotations(q)[:, :, 2]  # ankle from the knee, in shin lengths, thigh axes
    theta = q[:, 1]
    axis_phi = np.column_stack([-np.cos(theta), np.zeros(len(theta)), -np.sin(theta)])
    arm = np.cross(foot, down)
    pulls = np.column_stack([np.einsum("ij,ij->i", axis_phi, arm), -arm[:, 1]])
    limit = robot.limits.knee
    for axis, (low, high) in enumerate((limit.phi, limit.theta)):
        pulls[(q[:, axis] > high - STOP_FROM) & (pulls[:, axis] > 0.0), axis] = 0.0
        pulls[(q[:, axis] < low + STOP_FROM) & (pulls[:, axis] < 0.0), axis] = 0.0
    allowed = KNEE_ERROR * 2.0 * l1 / (2.0 * l1 + l2) + FRICTION / _weight(robot)
    allowed += FRICTION / (robot.mass.module * GRAVITY * l2)
    scores = np.max(np.abs(pulls), axis=1) / allowed
    scores[down[:, 2] > -math.cos(FOLDED)] = math.inf
    return np.asarray(scores, float)


def _weight(robot: RobotConfig) -> float:
    """Return the stiffness from gravity of a hanging leg at its hip, N m/rad."""
    l1, l2 = robot.geometry.l1, robot.geometry.l2
    return robot.mass.module * GRAVITY * (2.0 * l1 + l2)


def _leg_down(robot: RobotConfig, q_knee: Array) -> Array:
    """Return down in thigh axes (n, 3), for knees (n, 2) of a leg that hangs from its hip."""
    l1, l2 = robot.geometry.l1, robot.geometry.l2
    moment = np.array([0.0, 0.0, -2.0 * l1]) - l2 * rotations(q_knee)[:, :, 2]
    return np.asarray(moment / np.linalg.norm(moment, axis=1, keepdims=True), float)
