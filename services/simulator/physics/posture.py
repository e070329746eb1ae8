"""Posture of the simulated robot, loads of its soles, and whether it has fallen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from shared.arrays import Array
from shared.bus.messages import Pair, Vector3
from shared.clamp import clamp
from shared.extras import late

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = late("mujoco")

FALLEN_HEIGHT: Final = 0.60
"""Height of the torso below which the robot has fallen, m; a crawl goes down to 0.79."""
FALLEN_ANGLE: Final = 0.6
"""Roll or yaw of the torso above which the robot has fallen, rad."""
FALLEN_TILT: Final = 0.6
"""Tilt of a sole against the floor above which the robot has fallen, rad."""
LEAST_N: Final = 1e-3
"""Minimum load of a sole for which a centre of pressure is computed, N."""


class _MeasuredPosture(NamedTuple):
    """Posture of the robot, world axes."""

    com: Vector3
    """m"""
    torso: Vector3
    """m"""
    angles: Vector3
    """Roll, pitch, yaw of the torso, rad."""
    tilts: list[float]
    """Tilt of the right and the left sole against the floor, rad."""
    slip: float
    """Largest distance of a foot from its initial position, m."""
    feet: Pair
    """Mean offset of both feet from their initial positions, x and y, m."""

    @property
    def fallen(self) -> bool:
        roll, _, yaw = self.angles
        return (
            self.torso[2] < FALLEN_HEIGHT
            or max(abs(roll), abs(yaw)) > FALLEN_ANGLE
            or max(self.tilts) > FALLEN_TILT
            or not all(map(math.isfinite, self.torso))
        )


class SoleLoad(NamedTuple):
    """Force of the floor on one sole."""

    force: Vector3
    """N, world."""
    cop: Pair
    """Centre of pressure, x and y, m, world; (0, 0) without a load."""


def measure_posture(data: Any, torso: int, feet: Sequence[int], ankles: Array) -> _MeasuredPosture:
    """Return the posture after a step; `ankles` (2, 3), m, are the feet's initial positions."""
    rotation = data.xmat[torso].reshape(3, 3)
    roll = math.asin(clamp(rotation[2, 1], -1.0, 1.0))
    pitch = math.atan2(-rotation[2, 0], rotation[2, 2])
    yaw = math.atan2(-rotation[0, 1], rotation[1, 1])
    moved = np.array([data.xpos[foot] for foot in feet]) - ankles
    return _MeasuredPosture(
        com=as_vector(data.subtree_com[0]),
        torso=as_vector(data.xpos[torso]),
        angles=(roll, pitch, yaw),
        tilts=[math.acos(min(1.0, data.xmat[foot][8])) for foot in feet],
        slip=float(np.linalg.norm(moved, axis=1).max()),
        feet=(float(moved[:, 0].mean()), float(moved[:, 1].mean())),
    )


def sole_loads(model: Any, data: Any, feet: Sequence[int]) -> list[SoleLoad]:
    """Return each foot's load, from the contacts of the last step."""
    count = data.ncon
    contact, local = data.contact, np.zeros(6)
    forces = np.zeros((count, 3))
    for index in range(count):
        mujoco.mj_contactForce(model, data, index, local)
        forces[index] = local[:3] @ contact.frame[index].reshape(3, 3)  # of geom1 on geom2
    bodies = model.geom_bodyid[contact.geom] if count else np.zeros((0, 2), int)
    loads = []
    for foot in feet:
        on = forces * ((bodies[:, 1] == foot) * 1.0 - (bodies[:, 0] == foot))[:, None]
        force = on.sum(axis=0)
        bears = abs(force[2]) > LEAST_N
        x, y = (on[:, 2] @ contact.pos[:, :2] / force[2]).tolist() if bears else (0.0, 0.0)
        loads.append(SoleLoad(as_vector(force), (x, y)))
    return loads


def as_vector(values: Array) -> Vector3:
    """Return three numbers as a tuple."""
    return float(values[0]), float(values[1]), float(values[2])
