"""Geometry of the six-leg harness sensor: wrench from leg forces (docs/law.md#harness).

The sensor is a Stewart platform of six load cells between the torso and the operator's harness,
with ball joints at both ends of each leg, so that a leg carries force along its own line only. Legs
begin on the *base* (torso side) and end on the *platform* (operator's side). A leg in **tension**
is positive: it pulls the torso towards the operator, with force f_i along u_i, the unit vector from
base to platform.

Everything is in torso axes, relative to the harness point, which is assumed to be the platform's
centre. The sensor's axis is assumed to be the torso's x, with the operator in front. The layout is
the usual 6-6 hexapod: three pairs of points on each circle, the platform's pairs turned by 60
degrees relative to the base's, and each leg from its base point to the nearest platform point. At a
half angle of 30 degrees inside a pair, both hexagons are regular and alike, and the platform can
twist freely (singular).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from shared.exceptions import ConfigError

Matrix = npt.NDArray[np.float64]

N_LEGS: Final = 6

PAIR_HALF_ANGLE: Final = math.radians(15.0)
"""Half the angle between the two points of a pair, on both circles (assumption)."""

CONDITION_MAX: Final = 100.0
"""Maximum condition number of G; beyond it, errors of the load cells are amplified too much."""


def leg_points(base_radius: float, platform_radius: float, height: float) -> tuple[Matrix, Matrix]:
    """Return where the six legs begin and end, in m, torso axes, from the harness point.

    Base points (6, 3) at x = -height, and platform points (6, 3) at x = 0. Angles run from +y
    towards +z. Legs 0 to 5 are numbered in that direction.
    """
    turns = 2.0 * math.pi / 3.0 * np.repeat(np.arange(3), 2)
    sides = np.tile([1.0, -1.0], 3)
    middles = turns + math.pi / 3.0  # of the platform's pairs; the base's are 60 degrees off
    base_angles = middles - sides * (math.pi / 3.0 - PAIR_HALF_ANGLE)
    platform_angles = middles - sides * PAIR_HALF_ANGLE
    base = _circle(base_radius, base_angles, -height)
    platform = _circle(platform_radius, platform_angles, 0.0)
    return base, platform


def geometry_matrix(base_radius: float, platform_radius: float, height: float) -> Matrix:
    """Return G (6, 6): operator's wrench on the torso = G @ leg forces.

    Column i is [u_i; b_i x u_i]. The wrench is [force in N; moment in N m] about the harness point
    in torso axes; leg forces are in N, tension positive. The radii of the circles on the torso's
    and the operator's side, and the height between them, are in m. Raises ConfigError if G is
    singular, or so nearly singular that the wrench would be noise.
    """
    base, platform = leg_points(base_radius, platform_radius, height)
    u = platform - base
    lengths = np.linalg.norm(u, axis=1, keepdims=True)
    G: Matrix = np.full((N_LEGS, N_LEGS), math.inf)
    if np.all(lengths > 0.0):
        u /= lengths
        G = np.vstack([u.T, np.cross(base, u).T])
    condition = condition_number(G, platform_radius)
    if not condition <= CONDITION_MAX:
        found = (
            f"base_radius {base_radius:g} m, platform_radius {platform_radius:g} m and height "
            f"{height:g} m give a geometry matrix with condition number {condition:.3g}"
        )
        right = (
            f"must be at most {CONDITION_MAX:g}: the radii and the height must be of similar size"
        )
        raise ConfigError("robot file", "harness", found, right)
    return G


def condition_number(G: Matrix, length: float) -> float:
    """Return the condition number of G (6, 6) with moments in units of 1 N times `length`.

    Without a length, the number would depend on whether moments are in N m or N mm.
    Infinite if G is not finite or the length is zero.
    """
    if length <= 0.0 or not np.isfinite(G).all():
        return math.inf
    scale = np.array([1.0, 1.0, 1.0, 1.0 / length, 1.0 / length, 1.0 / length])
    return float(np.linalg.cond(scale[:, None] * G))


def _circle(radius: float, angles: Matrix, x: float) -> Matrix:
    return np.column_stack(
        [np.full(len(angles), x), radius * np.cos(angles), radius * np.sin(angles)]
    )
