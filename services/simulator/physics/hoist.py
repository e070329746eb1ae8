"""The hoist that holds the torso until the drives are armed, and lets it down."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HOIST_STIFFNESS: Final = (2e4, 2e3)
"""N/m and N m/rad of the hoist while it holds the torso."""
HOIST_DAMPING: Final = (2e3, 2e2)
"""N s/m and N m s/rad."""
HOIST_WEIGHT_SHARE: Final = 0.75
"""Part of the weight the hoist takes: the soles stay on the floor."""


class Hoist:
    """A spring-damper on the torso that also carries weight, by a share that is let down.

    Attributes:
        share: of its support: 1 hanging, 0 free.
        releasing: it is being let down.
        position: where it holds the torso, (3,) m, world.
    """

    def __init__(self, weight: float, release_s: float) -> None:
        """Hold.

        Args:
            weight: of the robot, N.
            release_s: time in which it lets go, s.
        """
        self.share = 1.0
        self.releasing = False
        self.position: Array = np.zeros(3)
        self._weight, self._release_s = weight, release_s

    def go_on(self, share: float) -> None:
        """Take over the share of another run."""
        self.share, self.releasing = share, share < 1.0

    def advance(self, position: Array, rotation: Array, rates: Array, dt: float) -> Array:
        """Let down further; return force and moment on the torso (6,), N and N m, world.

        Args:
            position: of the torso (3,), m, world.
            rotation: of the torso (3, 3).
            rates: its velocity, world, and angular velocity, torso axes (6,).
            dt: the time step, s.
        """
        if self.releasing:
            self.share = max(0.0, self.share - dt / self._release_s)
        k_lin, k_ang = HOIST_STIFFNESS
        b_lin, b_ang = HOIST_DAMPING
        turn = 0.5 * np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        wrench = np.concatenate(
            (
                k_lin * (self.position - position) - b_lin * rates[:3],
                -k_ang * turn - b_ang * (rotation @ rates[3:]),
            )
        )
        wrench[2] += HOIST_WEIGHT_SHARE * self._weight
        return np.asarray(self.share * wrench, float)
