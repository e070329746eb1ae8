"""Rotations as the law needs them: 3-1-2 Euler angles and small rotation vectors.

R = Rz(psi) Rx(phi) Ry(theta), active, world from torso (design section 2; the paper
prints the transpose). roll = phi, pitch = theta, yaw = psi, in that order in p.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def angles_from_rotation(rotation: Array) -> tuple[float, float, float]:
    """Return (roll, pitch, yaw) in rad of a rotation (3, 3); paper eq. for Theta_torso.

    Singular at roll = +-pi/2, which no stance comes near.
    """
    (_, r01, _), (_, r11, _), (r20, r21, r22) = rotation.tolist()
    return (
        math.asin(min(1.0, max(-1.0, r21))),
        math.atan2(-r20, r22),
        math.atan2(-r01, r11),
    )


def rotation_from_angles(roll: float, pitch: float, yaw: float) -> Array:
    """Return R = Rz(yaw) Rx(roll) Ry(pitch), (3, 3)."""
    cf, sf = math.cos(roll), math.sin(roll)
    ct, st = math.cos(pitch), math.sin(pitch)
    cp, sp = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cp * ct - sp * sf * st, -sp * cf, cp * st + sp * sf * ct],
            [sp * ct + cp * sf * st, cp * cf, sp * st - cp * sf * ct],
            [-cf * st, sf, cf * ct],
        ]
    )
