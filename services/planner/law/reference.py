"""Reference pose of a tick, and the law's quantities there, from one graph. Pure.

The graph (`services.planner.law.symbolic`) makes one Gauss-Newton step of the inverse kinematics
from the extrapolated last reference. While the planner leads, that step is below `STEP_SURE`, so
its error is within the solver's tolerance and nothing is evaluated twice. While the planner holds,
the graph makes two steps from the measured pose to the centred one. If `STEPS_MAX` steps are too
few, or a step leaves the joint limits, `InverseKinematics` solves, and the graph is evaluated at
its solution.
"""

from __future__ import annotations

from typing import Final

import msgspec
import numpy as np

from services.planner.law.inverse_kinematics import (
    STEP_MAX,
    STEP_SURE,
    IkResult,
    InverseKinematics,
)
from services.planner.law.kinematics import Kinematics, graphs_of
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.robot.compiled_graph import CompiledGraph

STEPS_MAX: Final = 3
"""Maximum number of the graph's steps. Near a solution each step squares the error."""


class _ReferenceInputs(msgspec.Struct, frozen=True):
    """Arguments of the graph, in its order. `Reference` writes all arrays except `stance`."""

    q: Array
    """Joint angles (12,), rad, at which the graph is evaluated."""
    stance: Array
    """Right foot relative to the left (6,), as in `Kinematics`; the caller writes it."""
    D_left: Array
    """Load sharing (6, 6), chosen at the measured pose."""
    p_ref: Array
    pdot_ref: Array
    F_O: Array
    """Force and moment that hold the body (6,), N and N m, world."""
    F_assist: Array
    """Force at the harness (3,), N, world."""
    assist_rate: Array
    """Rate of F_assist (3,), N/s."""
    low: Array
    """Joint limits (12,), rad."""
    high: Array


class Reference:
    """The reference pose.

    `solve` and `evaluate` write these arrays, and the next call overwrites them. All except `q` are
    evaluated at the pose before the last step, less than `STEP_SURE` rad from `q`:

    - `q` (12,): q_ref, rad; `v` (12,): v_ref, rad/s.
    - `T` (12, 6): joint rates per unit of p along the closed chain.
    - `p` (6,), `J` (6, 12), `J_harness` (3, 12): as in `Kinematics`.
    - `hessian_O` (12, 12): change of gravity and assist torque with the joints, N m/rad.
    - `gravity` (12,): F_O^T J; `assist` (12,): F_assist^T J_harness; N m.
    - `dtau_ff` (12,): change of both along v_ref and with the assist, N m/s.

    `load` sets `inputs`; the caller writes `inputs.stance`.
    """

    def __init__(self, config: RobotConfig) -> None:
        limits = np.array(config.joint_limits())
        self._ik = InverseKinematics(Kinematics(config), limits)
        self._graph = CompiledGraph(graphs_of(config).reference)
        self.inputs = _ReferenceInputs(*self._graph.arguments)
        self.inputs.low[:], self.inputs.high[:] = limits.T
        (
            self._q_next, self._check, self.T, self.v, self.p, self.J, self.J_harness,
            self.hessian_O, self.gravity, self.assist, self.dtau_ff,
        ) = self._graph.results  # fmt: skip
        self.q: Array = np.zeros(12)

    def load(
        self, pdot_ref: Array, F_O: Array, F_assist: Array, assist_rate: Array, D_left: Array
    ) -> None:
        """Set the inputs of the next `solve` or `evaluate` other than the pose.

        The arguments are as in `_ReferenceInputs`; `pdot_ref` in m/s and rad/s.
        """
        inputs = self.inputs
        inputs.pdot_ref[:], inputs.F_O[:] = pdot_ref, F_O
        inputs.F_assist[:], inputs.assist_rate[:] = F_assist, assist_rate
        inputs.D_left[:] = D_left

    def solve(self, start: Array, p_ref: Array) -> IkResult:
        """Solve q = IK(p_ref), and evaluate all arrays there: docs/law.md (7).

        Args:
            start: initial joint angles (12,), rad.
            p_ref: (6,), m and rad.
        """
        inputs = self.inputs
        inputs.q[:], inputs.p_ref[:] = start, p_ref
        for iterations in range(1, STEPS_MAX + 1):
            self._graph()
            largest, beyond = self._check.tolist()
            if not (0.0 <= largest < STEP_MAX and beyond <= 0.0):  # mmax turns NaN into -inf
                break
            if largest < STEP_SURE:
                self.q[:] = self._q_next
                return IkResult(iterations, largest * largest)
            inputs.q[:] = self._q_next
        ik = self._ik
        ik.q[:], ik.kinematics.stance[:] = start, inputs.stance
        result = ik.solve(p_ref, inputs.D_left)
        self.evaluate(ik.q)
        return result

    def expected(self, dt: float) -> Array:
        """Return the reference (12,), rad, extrapolated by dt (s) at its present rate.

        It is clipped to the joint limits.
        """
        start: Array = self.v * dt
        start += self.q
        if not np.isfinite(start).all():
            start[:] = self.q
        np.maximum(start, self.inputs.low, out=start)
        np.minimum(start, self.inputs.high, out=start)
        return start

    def evaluate(self, q: Array) -> None:
        """Set the reference to q (12,), rad, and evaluate all arrays there."""
        self.q[:] = self.inputs.q[:] = q
        self._graph()

    def kinematics(self) -> Kinematics:
        """Return the kinematics at the pose of the last evaluation; not meant for every tick."""
        kinematics = self._ik.kinematics
        kinematics.stance[:] = self.inputs.stance
        kinematics.update(self.inputs.q, self.inputs.D_left)
        return kinematics
