"""Inverse kinematics with both feet on the ground (design section 3).

Six task rows (p = p_ref) and six closure rows (both legs agree on the torso) make a
square system in the 12 joint angles. Gauss-Newton from the last solution: one or two
steps a tick.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.planner.kinematics import Kinematics
from shared.joints import N_JOINTS

Array = NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest residual of a solution, m or rad."""
DAMPING = 1e-4
"""Levenberg damping: bounds the step where the legs are nearly singular."""
STEP_SURE = 1e-3
"""rad; the error of a Gauss-Newton step is below its square (m or rad), so below `TOLERANCE`."""
STEP_MAX = 0.2
"""rad; a longer step leaves the region where the linearisation is good."""


class IkResult(NamedTuple):
    """Outcome of a solve."""

    iterations: int
    residual: float
    """Largest absolute row, m or rad."""

    @property
    def converged(self) -> bool:
        """True if the residual is within tolerance."""
        return self.residual <= TOLERANCE


class InverseKinematics:
    """q_ref = IK(p_ref), warm-started; `kinematics` is left updated at the solution."""

    def __init__(self, kinematics: Kinematics, limits: Array) -> None:
        """Take the kinematics to solve with and the joint limits (12, 2), rad."""
        self.kinematics = kinematics
        self.q: Array = np.zeros(N_JOINTS)
        self._low, self._high = limits[:, 0], limits[:, 1]
        self._system: Array = np.zeros((N_JOINTS, N_JOINTS))
        self._error: Array = np.zeros(N_JOINTS)
        self._damping = DAMPING**2 * np.eye(N_JOINTS)

    def solve(self, p_ref: Array, D_left: Array | None = None, iterations_max: int = 4) -> IkResult:
        """Improve `q` until p(q) = p_ref and the legs agree.

        A step so short that its second-order error is below the tolerance is taken
        without computing the kinematics again: from tick to tick one evaluation does.
        `kinematics` is then at most `STEP_SURE` rad from `q`.

        Args:
            p_ref: (6,), m and rad.
            D_left: load sharing to use, as in `Kinematics.update`; where the legs
                agree they change J but not p.
            iterations_max: Gauss-Newton steps at most.
        """
        residual = self._residual(p_ref, D_left)
        iterations = 0
        while residual > TOLERANCE and iterations < iterations_max:
            before = self.q.copy()
            step, limited = self._limited_step()
            self.q += step
            iterations += 1
            largest = float(np.abs(step).max())
            if largest < STEP_SURE and not limited:
                return IkResult(iterations, largest * largest)
            after = self._residual(p_ref, D_left)
            if after > residual and (limited or largest < STEP_MAX / 2):
                self.q[:] = before  # at a limit there may be nothing better
                return IkResult(iterations, self._residual(p_ref, D_left))
            residual = after
        return IkResult(iterations, residual)

    def _limited_step(self) -> tuple[Array, bool]:
        """Return the next step (12,), inside the joint limits, and whether they changed it.

        Joints that a step would push out of a limit they stand at are held, and the
        others do what is left to do: clipping alone lets the rest run away.
        """
        step = self.solve_rates(self._error)
        held = ((self.q >= self._high) & (step > 0.0)) | ((self.q <= self._low) & (step < 0.0))
        limited = bool(held.any())
        if limited:
            A = self._system * ~held
            step = np.asarray(np.linalg.solve(A.T @ A + self._damping, A.T @ self._error), float)
        largest = float(np.abs(step).max())
        if largest > STEP_MAX:
            step *= STEP_MAX / largest
        inside = np.minimum(np.maximum(self.q + step, self._low), self._high) - self.q
        return inside, limited or bool((inside != step).any())

    def solve_rates(self, right_side: Array) -> Array:
        """Return x (12,) with [J; C] x = right side (12,), damped."""
        A = self._system
        return np.asarray(np.linalg.solve(A.T @ A + self._damping, A.T @ right_side), float)

    def _residual(self, p_ref: Array, D_left: Array | None) -> float:
        kinematics = self.kinematics
        kinematics.update(self.q, D_left)
        self._system[:6], self._system[6:] = kinematics.J, kinematics.C
        np.subtract(p_ref, kinematics.p, out=self._error[:6])
        np.negative(kinematics.closure, out=self._error[6:])
        return float(np.abs(self._error).max())
