"""Measures the simulated robot's posture, and whether it has fallen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.bus.messages import Vector3
from shared.clamp import clamp

Array = NDArray[np.float64]

FALLEN_HEIGHT: Final = 0.60
"""m; a crawl goes down to 0.79."""
FALLEN_ANGLE: Final = 0.6
"""rad of roll or yaw."""
FALLEN_TILT: Final = 0.6
"""rad of a sole against the floor."""


class MeasuredPosture(NamedTuple):
    """MeasuredPosture of the robot, world axes."""

    com: Vector3
    """m"""
    torso: Vector3
    """m"""
    angles: Vector3
    """Roll, pitch, yaw of the torso, rad."""
    tilts: list[float]
    """Tilt of the right and the left sole against the floor, rad."""
    slip: float
    """Largest distance of a foot from its place, m."""

    @property
    def fallen(self) -> bool:
        """True if the robot is down."""
        roll, _, yaw = self.angles
        return (
            self.torso[2] < FALLEN_HEIGHT
            or max(abs(roll), abs(yaw)) > FALLEN_ANGLE
            or max(self.tilts) > FALLEN_TILT
            or not all(map(math.isfinite, self.torso))
        )


def measure_posture(data: Any, torso: int, feet: Sequence[int], ankles: Array) -> MeasuredPosture:
    """Return the posture.

    Args:
        data: MuJoCo's, after a step.
        torso: id of the body.
        feet: ids of the bodies, by side.
        ankles: where the feet were placed (2, 3), m.
    """
    rotation = data.xmat[torso].reshape(3, 3)
    roll = math.asin(clamp(rotation[2, 1], -1.0, 1.0))
    pitch = math.atan2(-rotation[2, 0], rotation[2, 2])
    yaw = math.atan2(-rotation[0, 1], rotation[1, 1])
    positions = np.array([data.xpos[foot] for foot in feet])
    return MeasuredPosture(
        com=as_vector(data.subtree_com[0]),
        torso=as_vector(data.xpos[torso]),
        angles=(roll, pitch, yaw),
        tilts=[math.acos(min(1.0, data.xmat[foot][8])) for foot in feet],
        slip=float(np.linalg.norm(positions - ankles, axis=1).max()),
    )


def as_vector(values: Array) -> Vector3:
    """Return three numbers as a tuple."""
    return float(values[0]), float(values[1]), float(values[2])
