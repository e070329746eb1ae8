"""Solves the inverse kinematics with both feet on the ground (docs/law.md).

Six task rows (p = p_ref) and six closure rows (both legs agree on the torso) form a square system
in the 12 joint angles. There are two solvers:

- `solve`, from a solution near by: Gauss-Newton, one or two steps. A tick needs it only where the
  single step of `services.planner.law.reference` is too long, or at a joint limit.
- `solve_from_anywhere`, at the start and in tools: Levenberg-Marquardt inside the joint limits,
  from several starts. If p_ref is out of reach, it ends at the nearest pose at which the legs still
  agree, and reports what limits it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from services.planner.law.kinematics import Kinematics
from services.planner.law.small_matrices import LuDecomposition
from services.planner.law.symbolic import DAMPING
from shared.arrays import Array
from shared.joints import JOINTS, N_JOINTS, N_LEG

TOLERANCE = 1e-6
"""Largest residual of a solution, m or rad."""
STEP_SURE = 1e-3
"""rad; a Gauss-Newton step's error is below the step's square (m or rad), so below `TOLERANCE`."""
STEP_MAX = 0.2
"""rad; a longer step leaves the region in which the linearisation is good."""

GAIN_AT_LIMIT = 0.01
"""Least reduction, as a fraction of the sum of squares. With smaller steps, out of reach, the legs
would creep into a twist."""

COLD_STEP_MAX = 0.5
"""rad; longer than `STEP_MAX`, because here a step that does not reduce the cost is taken back."""
EVALUATIONS_MAX = 60
"""Evaluations of the kinematics per start; from a bent stand the median is 8."""
CLOSURE_WEIGHT = 10.0
"""Weight of the closure relative to p, where both cannot be met; the shift removes the rest."""
CLOSING_ROUNDS = 5
"""Rounds of the multiplier method; each reduces the closure error about a hundredfold."""
STATIONARY = 1e-3
"""Fraction of the error; joint gradients below it count as zero."""
EQUAL_SHARING: Array = 0.5 * np.eye(6)
"""Load sharing (6, 6) for a cold start: the same at every q, so that J is exactly dp/dq."""
POSE_ROWS = (
    *(("COM x", "m"), ("COM y", "m"), ("COM z", "m")),
    *(("roll", "rad"), ("pitch", "rad"), ("yaw", "rad")),
)
"""Names and units of p."""


class IkResult(NamedTuple):
    """Result of a solve."""

    iterations: int
    residual: float
    """Largest absolute row, m or rad."""

    @property
    def converged(self) -> bool:
        """True if the residual is within tolerance."""
        return self.residual <= TOLERANCE


class IkEnding(IntEnum):
    """How a solve from anywhere ended."""

    CONVERGED = 0
    JOINT_LIMIT = 1
    """The nearest pose inside the joint limits."""
    OUT_OF_REACH = 2
    """The nearest pose that the legs reach; no joint limit stops them."""
    UNFINISHED = 3
    """The evaluations ran out; a nearer pose may exist."""


class Reach(NamedTuple):
    """Distance of a configuration from p_ref, and the limits that prevent a nearer one."""

    outcome: IkEnding
    error: Array
    """p_ref - p (6,), m and rad: the missed rows, with sign."""
    closure: float
    """Largest difference between the legs' estimates of the torso, m or rad."""
    stopped: tuple[int, ...]
    """Per joint (12): +1 if pressed against its upper limit, -1 if against its lower, else 0."""
    evaluations: int
    """Evaluations of the kinematics since the last solve began."""

    @property
    def converged(self) -> bool:
        """True if p_ref was reached and the legs agree."""
        return self.outcome is IkEnding.CONVERGED


class InverseKinematics:
    """Solves q_ref = IK(p_ref) into `q`; leaves `kinematics` updated at the solution."""

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
        self._evaluations = 0

    def solve(self, p_ref: Array, D_left: Array | None = None, iterations_max: int = 4) -> IkResult:
        """Improve `q` until p(q) = p_ref and the legs agree.

        A step whose second-order error is below the tolerance is taken without computing the
        kinematics again. `kinematics` is then at most `STEP_SURE` rad from `q`.

        Args:
            p_ref: (6,), m and rad.
            D_left: load sharing to use, as in `Kinematics.update`; where the legs agree it changes
                J but not p.
            iterations_max: largest number of Gauss-Newton steps.
        """
        self._evaluations = 0
        residual = self._residual(p_ref, D_left)
        iterations = 0
        while residual > TOLERANCE and iterations < iterations_max:
            before, cost = self.q.copy(), float(self._error @ self._error)
            step, limited = self._step_within_limits()
            self.q += step
            if limited:
                self.q[:] = self._inside(self.q)  # exactly inside the limits
            iterations += 1
            largest = float(np.abs(step).max())
            if largest < STEP_SURE and not limited:
                return IkResult(iterations, largest * largest)
            after = self._residual(p_ref, D_left)
            gained = cost - float(self._error @ self._error)
            long_step = not limited and largest >= STEP_MAX / 2  # it may have to go uphill first
            if not long_step and gained < (GAIN_AT_LIMIT * cost if limited else 0.0):
                self.q[:] = before
                return IkResult(iterations, self._residual(p_ref, D_left))
            residual = after
        return IkResult(iterations, residual)

    def _step_within_limits(self) -> tuple[Array, bool]:
        """Return the next step (12,), inside the joint limits, and True if the limits changed it.

        Clipping alone would let the other joints move on without the joint that stopped.
        """
        step = _limited_length(self.solve_rates(self._error), STEP_MAX)
        limited = bool((self._inside(self.q + step) != self.q + step).any())
        if limited:
            step = self._damped_step(self._system, self._error, DAMPING**2)
            step = _limited_length(step, STEP_MAX)
        return step, limited

    def solve_rates(self, right_side: Array) -> Array:
        """Return x (12,) that solves [J; C] x = right side (12,), damped."""
        A = self._system
        if self._normal is None:
            self._normal = LuDecomposition(A.T @ A + self._damping)
        return self._normal.solve(A.T @ right_side)

    def solve_from_anywhere(self, p_ref: Array) -> Reach:
        """Improve `q` as far as possible inside the joint limits, from any configuration.

        The solver starts at `q`, then at bent stands with the requested pitch, then with one knee
        twisted. Near the top of the workspace some poses lie beyond a fold that no descent from a
        stand crosses. If no start reaches p_ref, `q` is the nearest pose found at which the legs
        agree. Nothing is random. Not meant for every tick: out of reach it takes several hundred
        evaluations.

        Args:
            p_ref: (6,), m and rad.
        """
        self._evaluations = 0
        initial = self._inside(self.q)
        nearest, cost_least = initial, math.inf
        for start in (initial, *self._start_poses(float(p_ref[4]))):
            self.q[:] = start
            cost = self._descend(p_ref, np.ones(N_JOINTS), np.zeros(N_JOINTS))
            if cost < cost_least:
                nearest, cost_least = self.q.copy(), cost
            if float(np.abs(self._error).max()) <= TOLERANCE:
                break
        else:
            # from `initial` too: the nearest pose with the legs apart may not be the closed one
            found = [self._nearest_closed(p_ref, start) for start in (nearest, initial)]
            self.q[:] = min(found, key=lambda one: one[0])[1]
        return self.examine(p_ref)

    def examine(self, p_ref: Array) -> Reach:
        """Return the distance of `q` from p_ref and what limits it; `q` does not change.

        At the nearest pose where the legs agree, J^T e + C^T mu is zero for some mu. Joints at
        a limit that would move beyond it are excepted. These are the optimality conditions of
        min |e|^2 / 2, e = p_ref - p, subject to closure = 0 and the limits.

        Args:
            p_ref: (6,), m and rad.
        """
        residual = self._residual(p_ref, None)
        error = self._error[:6].copy()
        closure = float(np.abs(self._error[6:]).max())
        if residual <= TOLERANCE:
            outcome, stopped = IkEnding.CONVERGED, np.zeros(N_JOINTS)
        else:
            at_limit = 1.0 * (self.q >= self._high - 1e-9) - (self.q <= self._low + 1e-9)
            pull, C = error @ self._system[:6], self._system[6:]
            free = at_limit == 0.0
            mu = np.linalg.lstsq(C[:, free].T, -pull[free], rcond=None)[0]
            left = pull + mu @ C
            not_stationary = np.abs(left) > STATIONARY * float(np.abs(error).max())
            stopped = at_limit * (not_stationary & (left * at_limit > 0.0))
            if closure > STEP_SURE or bool((not_stationary & (stopped == 0.0)).any()):
                outcome = IkEnding.UNFINISHED
            else:
                outcome = IkEnding.JOINT_LIMIT if stopped.any() else IkEnding.OUT_OF_REACH
        return Reach(outcome, error, closure, tuple(map(int, stopped)), self._evaluations)

    def _start_poses(self, pitch: float) -> Iterator[Array]:
        """Yield configurations (12,) to start from, with a torso pitch in rad."""
        for knee in (-0.5, -1.6):
            yield self._inside(np.tile([0.0, 0.2, 0.0, knee, 0.0, pitch - 0.2 - knee], 2))
        for twist in (-0.5, 0.5):
            for leg in (slice(0, N_LEG), slice(N_LEG, N_JOINTS)):
                q = np.tile([0.0, 0.0, 0.0, -0.5, 0.0, pitch + 0.5], 2)
                q[leg] = [0.0, 0.0, twist, -0.3, -twist, pitch + 0.3]
                yield self._inside(q)

    def _nearest_closed(self, p_ref: Array, start: Array) -> tuple[float, Array]:
        """Return the weighted error and q of the nearest pose downhill at which the legs agree.

        It uses the method of multipliers: `shift` holds the closure against the pull of p_ref.
        """
        self.q[:] = start
        weights = np.repeat([1.0, CLOSURE_WEIGHT], 6)
        shift = np.zeros(N_JOINTS)
        for _ in range(CLOSING_ROUNDS):
            self._descend(p_ref, weights, shift)
            shift[6:] += weights[6:] * self._error[6:]
        return float(np.linalg.norm(weights * self._error)), self.q.copy()

    def _descend(self, p_ref: Array, weights: Array, shift: Array) -> float:
        """Move `q` downhill in |weights * error + shift|^2 until it stops; return that cost.

        Levenberg-Marquardt with the joint limits as an active set. A step is kept only if it gains
        at least a fraction of the gain that the linearisation predicts.
        """
        self._residual(p_ref, EQUAL_SHARING)
        e, A = weights * self._error + shift, weights[:, None] * self._system
        cost, damping = float(e @ e), 1e-3
        last = self._evaluations + EVALUATIONS_MAX
        while self._evaluations < last and damping < 1e6:
            if float(np.abs(self._error).max()) <= 0.1 * TOLERANCE:
                break
            before, kept = self.q.copy(), self._error.copy()
            step = _limited_length(self._damped_step(A, e, damping), COLD_STEP_MAX)
            e_linear = e - A @ step
            promised = cost - float(e_linear @ e_linear)
            if abs(promised) <= 1e-14 * cost:
                break
            self.q[:] = self._inside(self.q + step)  # exactly inside the limits
            self._residual(p_ref, EQUAL_SHARING)
            e_after = weights * self._error + shift
            gained = cost - float(e_after @ e_after)
            if gained > max(0.0, 1e-3 * promised):
                e, A, cost = e_after, weights[:, None] * self._system, cost - gained
                damping = max(1e-12, damping * (0.1 if gained > 0.75 * promised else 1.0))
            else:
                self.q[:], self._error[:] = before, kept
                damping = 8.0 * max(damping, 1e-6)
        return cost

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
        self._evaluations += 1
        kinematics = self.kinematics
        kinematics.update(self.q, D_left)
        self._system[:6], self._system[6:] = kinematics.J, kinematics.C
        self._normal = None
        np.subtract(p_ref, kinematics.p, out=self._error[:6])
        np.negative(kinematics.closure, out=self._error[6:])
        return float(np.abs(self._error).max())


def _limited_length(step: Array, largest: float) -> Array:
    """Return a step of the same direction with no part above `largest`."""
    return step * (largest / max(largest, float(np.abs(step).max())))


def describe(reach: Reach, p_ref: Array, limits: Array) -> str:
    """Return one line of text: the requested pose, the nearest one and the limits that stop it.

    Args:
        reach: result of a solve for p_ref.
        p_ref: (6,), m and rad.
        limits: of the joints (12, 2), rad.
    """
    if reach.converged:
        return "p_ref is reached"
    scale = max(float(np.abs(reach.error).max()), TOLERANCE)
    digits = max(2, 1 - math.floor(math.log10(scale)))
    misses = [
        f"{name} {p_ref[row]:.{digits}f} {unit} wanted, "
        f"{p_ref[row] - reach.error[row]:.{digits}f} {unit}"
        for row, (name, unit) in sorted(enumerate(POSE_ROWS), key=lambda r: -abs(reach.error[r[0]]))
        if abs(reach.error[row]) >= 0.1 * scale
    ] or [f"the legs disagree by {reach.closure:.{digits}g} m or rad, which"]
    stops = ", ".join(
        f"{joint} at its limit {limits[index, 0 if side < 0 else 1]:g} rad"
        for index, (joint, side) in enumerate(zip(JOINTS, reach.stopped, strict=True))
        if side
    )
    if reach.outcome is IkEnding.UNFINISHED:
        verdict = "was not reached"
        why = f"stopped after {reach.evaluations} evaluations, a closer pose may exist"
    else:
        verdict = "cannot be reached"
        why = stops or "the legs reach no further, no joint is at its limit"
    others = "".join(f"; {row} there" for row in misses[1:])
    return f"p_ref {verdict}: {misses[0]} is the closest: {why}{others}"
