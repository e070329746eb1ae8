"""Poses of torso, modules and harness in each other's frames, and the capture point. Pure.

Rotations are unit quaternions (x, y, z, w). The frames are `world`; `torso`; below it on each leg
`hip_*` (of the thigh), `knee_*` (of the shin) and `ankle_*` (of the foot); `harness` on the torso
(docs/law.md#the-robot).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Final, NamedTuple, TypeAlias

from shared.bus.messages import Pair, Vector3, Vector6
from shared.config.robot_config import GRAVITY
from shared.config.sections import GeometryConfig
from shared.joints import MODULE_INDEX, SIDES
from shared.robot.robot_model import side_sign

Quaternion: TypeAlias = tuple[float, float, float, float]

ORIGIN: Final[Vector3] = (0.0, 0.0, 0.0)
UPRIGHT: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)


class FramePose(NamedTuple):
    """Pose of a frame in its parent."""

    parent: str
    child: str
    position: Vector3
    rotation: Quaternion


def body_frames(geometry: GeometryConfig, q: Sequence[float]) -> list[FramePose]:
    """Return the frames on the torso and below it, at joint angles (12,), rad."""
    harness = FramePose("torso", "harness", geometry.harness_point, UPRIGHT)
    modules = (
        FramePose(parent, module, position, _module_rotation(*_joint_pair(q, module)))
        for side in SIDES
        for parent, module, position in leg_modules(geometry, side)
    )
    return [harness, *modules]


def leg_modules(geometry: GeometryConfig, side: str) -> tuple[tuple[str, str, Vector3], ...]:
    """Return a leg's modules from the torso down: (frame above, module, position in it, m)."""
    hip, knee, ankle = (f"{kind}_{side}" for kind in ("hip", "knee", "ankle"))
    return (
        ("torso", hip, (0.0, side_sign(side) * geometry.w_hip / 2, 0.0)),
        (hip, knee, (0.0, 0.0, -geometry.l1)),
        (knee, ankle, (0.0, 0.0, -geometry.l2)),
    )


def _joint_pair(q: Sequence[float], module: str) -> tuple[float, float]:
    """Return (phi, theta) of a module from the joint angles (12,), rad."""
    number = 2 * MODULE_INDEX[module]
    return q[number], q[number + 1]


def torso_pose(
    geometry: GeometryConfig, q: Sequence[float], stance: Vector6
) -> tuple[Vector3, Quaternion]:
    """Return the torso's pose in the world, m: the mean of the two legs' estimates.

    The world's origin is midway between the feet, at the height of the ankles; both soles are flat
    on the floor. Joint angles are (12,), rad; `stance` is as in `PlannerStatus`.
    """
    positions, rotations = [], []
    for side in SIDES:
        place, turned = _foot_place(geometry, side, stance)
        ankle, rotation = _ankle_in_torso(geometry, q, side)
        torso = product(turned, inverse(rotation))
        x, y, z = rotated(torso, ankle)
        positions.append((place[0] - x, place[1] - y, place[2] - z))
        rotations.append(torso)
    (a, b), (right, left) = positions, rotations
    sign = math.copysign(1.0, sum(map(operator.mul, right, left)))  # q and -q are one rotation
    mean = [r + sign * other for r, other in zip(right, left, strict=True)]
    length = math.hypot(*mean)
    x, y, z, w = (part / length for part in mean)
    middle = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2
    return middle, (x, y, z, w)


def _foot_place(geometry: GeometryConfig, side: str, stance: Vector6) -> tuple[Vector3, Quaternion]:
    """Return a foot's pose, world axes; each foot takes half of the stance."""
    half, y = -side_sign(side) / 2, side_sign(side) * geometry.w_base / 2
    dx, dy, dz, *turn = (half * part for part in stance)
    angle = math.hypot(*turn)
    if angle == 0.0:
        return (dx, y + dy, dz), UPRIGHT
    scale = math.sin(angle / 2) / angle
    rx, ry, rz = turn
    return (dx, y + dy, dz), (scale * rx, scale * ry, scale * rz, math.cos(angle / 2))


def _ankle_in_torso(
    geometry: GeometryConfig, q: Sequence[float], side: str
) -> tuple[Vector3, Quaternion]:
    """Return the pose of a foot in the torso's frame."""
    position, rotation = ORIGIN, UPRIGHT
    for _, module, offset in leg_modules(geometry, side):
        x, y, z = rotated(rotation, offset)
        position = position[0] + x, position[1] + y, position[2] + z
        rotation = product(rotation, _module_rotation(*_joint_pair(q, module)))
    return position, rotation


def torso_rotation(angles: Vector3) -> Quaternion:
    """Return Rz(yaw) Rx(roll) Ry(pitch)."""
    roll, pitch, yaw = angles
    return product(
        product(rotation_about(2, yaw), rotation_about(0, roll)), rotation_about(1, pitch)
    )


def _module_rotation(phi: float, theta: float) -> Quaternion:
    """Return the rotation of the part below a module in the part above it.

    From the foot up a module is Rx(phi) Ry(theta); from the torso down it is the inverse.
    """
    return product(rotation_about(1, -theta), rotation_about(0, -phi))


def rotation_about(axis: int, angle: float) -> Quaternion:
    """Return the rotation about an axis (0, 1, 2 for x, y, z), rad."""
    values = [0.0, 0.0, 0.0, math.cos(angle / 2)]
    values[axis] = math.sin(angle / 2)
    return values[0], values[1], values[2], values[3]


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation b followed by the rotation a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def inverse(rotation: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    x, y, z, w = rotation
    return -x, -y, -z, w


def rotated(rotation: Quaternion, vector: Vector3) -> Vector3:
    """Return a vector turned by a rotation."""
    turned = product(product(rotation, (*vector, 0.0)), inverse(rotation))
    return turned[0], turned[1], turned[2]


def capture_point(p: Sequence[float], pdot: Sequence[float], slope: Pair = (0.0, 0.0)) -> Pair:
    """Return where the body comes to rest, as an inverted pendulum: x - slope z + x' sqrt(z/g).

    The result is x and y, m, from midway between the ankles. The pose p begins with COM x y z, m,
    z > 0; its rate pdot is in m/s. The slope is the floor's rise along x and y, rad. It matters
    because p is in floor axes, where a COM vertically above the ankles is uphill by slope z.
    """
    swing = math.sqrt(p[2] / GRAVITY)
    return p[0] - slope[0] * p[2] + swing * pdot[0], p[1] - slope[1] * p[2] + swing * pdot[1]
