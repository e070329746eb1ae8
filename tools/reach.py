"""Offline solver for a stand at a requested pose p_ref, from any configuration.

It runs Levenberg-Marquardt inside the joint limits, from several starts. If p_ref is out of reach,
it returns the nearest pose at which the legs agree, and the limits that stop it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from services.planner.law.inverse_kinematics import (
    STEP_SURE,
    TOLERANCE,
    InverseKinematics,
    limited_length,
)
from shared.arrays import Array
from shared.joints import JOINTS, N_JOINTS, N_LEG

COLD_STEP_MAX = 0.5
"""Maximum step, rad; larger than `STEP_MAX`, because a step without enough gain is undone here."""
EVALUATIONS_MAX = 60
"""Evaluations of the kinematics per start; from a bent stand the median is 8."""
CLOSURE_WEIGHT = 10.0
"""Weight of the closure error relative to the error of p; `shift` removes the rest."""
CLOSING_ROUNDS = 5
"""Rounds of the multiplier method; each reduces the closure error about a hundredfold."""
STATIONARY = 1e-3
"""Joint gradients up to this fraction of the largest error count as zero."""
EQUAL_SHARING: Array = 0.5 * np.eye(6)
"""Load sharing (6, 6) for a cold start: the same at every q, so that J is exactly dp/dq."""
POSE_ROWS = (
    *(("COM x", "m"), ("COM y", "m"), ("COM z", "m")),
    *(("roll", "rad"), ("pitch", "rad"), ("yaw", "rad")),
)
"""Names and units of p."""


class IkEnding(IntEnum):
    """Outcome of a solve."""

    CONVERGED = 0
    JOINT_LIMIT = 1
    """The nearest pose inside the joint limits; at least one limit prevents a nearer one."""
    OUT_OF_REACH = 2
    """The nearest pose that the legs reach; no joint limit stops them."""
    UNFINISHED = 3
    """The evaluations ran out; a nearer pose may exist."""


class Reach(NamedTuple):
    """Distance of a configuration from p_ref, and the limits that prevent a nearer one."""

    outcome: IkEnding
    error: Array
    """p_ref - p (6,), m and rad."""
    closure: float
    """Largest difference between the legs' estimates of the torso's pose, m or rad."""
    stopped: tuple[int, ...]
    """Per joint (12): +1 if pressed against its upper limit, -1 if against its lower, else 0."""
    evaluations: int
    """Evaluations of the kinematics since the last solve began."""

    @property
    def converged(self) -> bool:
        """True if p_ref was reached and the legs agree."""
        return self.outcome is IkEnding.CONVERGED


class ReachSolver(InverseKinematics):
    """Inverse kinematics that starts from any configuration."""

    _evaluations = 0

    def solve_from_anywhere(self, p_ref: Array) -> Reach:
        """Move `q` as close to p_ref as the joint limits permit, from any configuration.

        Until p_ref is reached, the solver starts at `q`, then at bent stands with the requested
        pitch, then at stands with one knee twisted. Near the top of the workspace some poses lie
        beyond a fold that no descent from a stand crosses. If no start reaches p_ref, `q` is the
        nearest pose found at which the legs agree. The result is deterministic. Not for every tick:
        if p_ref is out of reach, a solve takes several hundred evaluations.

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
            # also from `initial`: the nearest pose may have legs that disagree by far
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
            step = limited_length(self._damped_step(A, e, damping), COLD_STEP_MAX)
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

    def _residual(self, p_ref: Array, D_left: Array | None) -> float:
        self._evaluations += 1
        return super()._residual(p_ref, D_left)


def describe(reach: Reach, p_ref: Array, limits: Array) -> str:
    """Return one line of text: the requested pose, the nearest one and the limits that stop it.

    Args:
        reach: result of a solve for p_ref.
        p_ref: (6,), m and rad.
        limits: joint limits (12, 2), rad.
    """
    if reach.converged:
        return "p_ref is reached"
    scale = max(float(np.abs(reach.error).max()), TOLERANCE)
    digits = max(2, 1 - math.floor(math.log10(scale)))
    misses = [
        f"{name} {p_ref[row]:.{digits}f} {unit} requested, "
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
        why = f"stopped after {reach.evaluations} evaluations; a closer pose may exist"
    else:
        verdict = "cannot be reached"
        why = stops or "the legs reach no further, and no joint is at its limit"
    others = "".join(f"; {row} there" for row in misses[1:])
    return f"p_ref {verdict}: {misses[0]} is the closest: {why}{others}"
