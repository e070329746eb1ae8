"""Inverse kinematics with both feet on the ground (docs/law.md).

Six task rows (p = p_ref) and six closure rows (both legs agree on the torso) form a square system
in the 12 joint angles. From a nearby solution, Gauss-Newton takes one or two steps. A tick needs
this solver only if the steps of `services.planner.law.reference` fail or reach a joint limit.
`tools.reach` solves from any pose.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from services.planner.law.kinematics import Kinematics
from services.planner.law.small_matrices import LuDecomposition
from services.planner.law.symbolic import DAMPING
from shared.arrays import Array
from shared.joints import N_JOINTS

TOLERANCE = 1e-6
"""Largest residual of a solution, m or rad."""
STEP_SURE = 1e-3
"""rad; a Gauss-Newton step shorter than this leaves an error (m or rad) below its square, and thus
below `TOLERANCE`."""
STEP_MAX = 0.2
"""rad; a longer step leaves the region in which the linearisation is good."""

GAIN_AT_LIMIT = 0.01
"""Minimum reduction of the sum of squares by a step at a limit, as a fraction. For a pose out of
reach, steps that gain less would let the legs creep into a twist."""


class IkResult(NamedTuple):
    """Result of a solve."""

    iterations: int
    residual: float
    """Largest absolute error of a row, m or rad."""

    @property
    def converged(self) -> bool:
        """True if the residual is within tolerance."""
        return self.residual <= TOLERANCE


class InverseKinematics:
    """Solves q_ref = IK(p_ref) into `q`; leaves `kinematics` updated at or near it."""

    def __init__(self, kinematics: Kinematics, limits: Array) -> None:
        """Set the kinematics to solve with and the joint limits (12, 2), rad."""
        self.kinematics = kinematics
        self.q: Array = np.zeros(N_JOINTS)
        self._low, self._high = limits[:, 0], limits[:, 1]
        self._system: Array = np.zeros((N_JOINTS, N_JOINTS))
        self._error: Array = np.zeros(N_JOINTS)
        self._damping = DAMPING**2 * np.eye(N_JOINTS)
        self._normal: LuDecomposition | None = None
        """Decomposition of A^T A with its damping, for `_system` A; None until it is needed."""

    def solve(self, p_ref: Array, D_left: Array | None = None, iterations_max: int = 4) -> IkResult:
        """Improve `q` until p(q) = p_ref and the legs agree.

        After a step whose second-order error is below the tolerance, the kinematics are not
        computed again. `kinematics` is then at most `STEP_SURE` rad from `q`.

        Args:
            p_ref: (6,), m and rad.
            D_left: load sharing to use, as in `Kinematics.update`; where the legs agree it changes
                J but not p.
            iterations_max: maximum number of Gauss-Newton steps.
        """
        residual = self._residual(p_ref, D_left)
        iterations = 0
        while residual > TOLERANCE and iterations < iterations_max:
            before, cost = self.q.copy(), float(self._error @ self._error)
            step, limited = self._step_within_limits()
            self.q += step
            if limited:
                self.q[:] = self._inside(self.q)  # exactly, despite rounding
            iterations += 1
            largest = float(np.abs(step).max())
            if largest < STEP_SURE and not limited:
                return IkResult(iterations, largest * largest)
            after = self._residual(p_ref, D_left)
            gained = cost - float(self._error @ self._error)
            long_step = not limited and largest >= STEP_MAX / 2  # its error may grow at first
            if not long_step and gained < (GAIN_AT_LIMIT * cost if limited else 0.0):
                self.q[:] = before
                return IkResult(iterations, self._residual(p_ref, D_left))
            residual = after
        return IkResult(iterations, residual)

    def _step_within_limits(self) -> tuple[Array, bool]:
        """Return the next step (12,), inside the joint limits, and True if the limits changed it.

        Clipping alone would move the other joints as if none had stopped at its limit.
        """
        step = limited_length(self.solve_rates(self._error), STEP_MAX)
        limited = bool((self._inside(self.q + step) != self.q + step).any())
        if limited:
            step = self._damped_step(self._system, self._error, DAMPING**2)
            step = limited_length(step, STEP_MAX)
        return step, limited

    def solve_rates(self, right_side: Array) -> Array:
        """Return x (12,) that solves [J; C] x = right side (12,), damped."""
        A = self._system
        if self._normal is None:
            self._normal = LuDecomposition(A.T @ A + self._damping)
        return self._normal.solve(A.T @ right_side)

    def _damped_step(self, A: Array, e: Array, damping: float) -> Array:
        """Return a damped step (12,) towards A step = e that ends inside the joint limits.

        Joints at a limit with the gradient pointing outwards are blocked from the start; all others
        may leave their limit. Joints that the step would take out of their range move up to the
        limit. The other joints share the remaining error.
        """
        room_low, room_high = self._low - self.q, self._high - self.q
        step = np.zeros(N_JOINTS)
        downhill = A.T @ e
        blocked = ((room_high <= 0.0) & (downhill > 0.0)) | ((room_low >= 0.0) & (downhill < 0.0))
        free = newly_blocked = ~blocked
        while newly_blocked.any():
            J = A * free
            gradient = J.T @ (e - A @ (step * ~free))
            unlimited = np.linalg.solve(J.T @ J + damping * np.eye(N_JOINTS), gradient)
            inside = np.minimum(np.maximum(unlimited, room_low), room_high)
            step = np.where(free, inside, step)
            newly_blocked = free & (inside != unlimited)
            free = free & ~newly_blocked
        return step

    def _inside(self, q: Array) -> Array:
        return np.minimum(np.maximum(q, self._low), self._high)

    def _residual(self, p_ref: Array, D_left: Array | None) -> float:
        kinematics = self.kinematics
        kinematics.update(self.q, D_left)
        self._system[:6], self._system[6:] = kinematics.J, kinematics.C
        self._normal = None
        np.subtract(p_ref, kinematics.p, out=self._error[:6])
        np.negative(kinematics.closure, out=self._error[6:])
        return float(np.abs(self._error).max())


def limited_length(step: Array, largest: float) -> Array:
    """Return the step, scaled down if an element exceeds `largest`."""
    return step * (largest / max(largest, float(np.abs(step).max())))
