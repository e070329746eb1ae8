"""The whole-body law: Hybrid Open-Loop Closed-Loop Control (paper, design section 3).

One tick, in the paper's letters:

    p, J                 from the measured joints
    p_ref = S_perp p_C + S p
    q_ref = IK(p_ref)
    v_ref                J v_ref = S J v + S_perp pdot_C, C v_ref = 0
    F     = K_p (p_ref - p) + B_p (pdot_ref - pdot) + F_O
    K_q, B_q             at q_ref; D the part that the joint services hold alone
    tau_ff  = J^T (m g z) + J_harness^T F_assist
    tau_coupled = (K_q - D)(q_ref - q) + (B_q - D_B)(v_ref - v)

Pure: no clock, bus or thread.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.planner.gains import GainLaw
from services.planner.inverse_kinematics import InverseKinematics
from services.planner.kinematics import Kinematics
from shared.config import GRAVITY, RobotConfig

Array = NDArray[np.float64]


class LawOutput(NamedTuple):
    """What one tick asks of the twelve joints, each (12,)."""

    q_ref: Array
    v_ref: Array
    tau_ff: Array
    dtau_ff: Array
    tau_coupled: Array
    k_p: Array
    k_d: Array
    p: Array
    """Measured pose (6,)."""
    pdot: Array
    p_ref: Array
    closure: Array
    assist: float
    """N"""
    ik_iterations: int
    ik_residual: float


class Hocca:
    """The law with its little memory: the closed-loop reference p_C and the assist."""

    def __init__(self, config: RobotConfig) -> None:
        """Prepare; the first tick starts from the measured pose."""
        self._measured = Kinematics(config)
        limits = np.array(config.joint_limits())
        self._ik = InverseKinematics(Kinematics(config), limits)
        self._gains = GainLaw(config)
        self._S = self._gains.S
        self._S_perp = 1.0 - self._S
        self._F_O: Array = np.zeros(6)
        self._F_O[2] = config.total_mass * GRAVITY
        self._assist_max = config.assist.force_max
        self._assist_rate_max = config.assist.rate_max
        self._recentre_s = config.law.recentre_s
        self._p_C0: Array = np.zeros(6)
        self._since_align_s = 0.0
        self._assist = 0.0
        self._aligned = False
        self._F_assist: Array = np.zeros(3)
        self._closed_rates: Array = np.zeros(12)

    def tick(
        self, q: Array, v: Array, assist_wanted: float, dt: float, *, align: bool = False
    ) -> LawOutput:
        """Run the law once.

        Args:
            q: measured joint angles (12,), rad.
            v: measured joint rates (12,), rad/s.
            assist_wanted: assist force that the operator asks for, N; rate limited here,
                but for the first tick, which takes over what HOLD carries.
            dt: time since the last tick, s.
            align: start from the measured pose, so that taking over makes no step: p_C is
                where the robot is, and glides to zero (COM over the ankles, no roll, no
                yaw) in `law.recentre_s` of ticks without `align`.
        """
        measured, ik = self._measured, self._ik
        measured.update(q)
        if align or not self._aligned:
            self._align(q, assist_wanted)
        pdot = measured.J @ v
        p_C, pdot_C = self._closed_loop_reference(dt)
        p_ref = self._S_perp * p_C + self._S * measured.p
        pdot_ref = self._S_perp * pdot_C + self._S * pdot
        assist_rate = self._advance_assist(assist_wanted, dt)

        result = ik.solve(p_ref, measured.D_left)
        q_ref = ik.q.copy()
        self._closed_rates[:6] = pdot_ref
        v_ref = ik.solve_rates(self._closed_rates)

        at_ref = ik.kinematics
        self._F_assist[2] = self._assist
        gains = self._gains
        F = gains.K_p * (p_ref - measured.p) + gains.B_p * (pdot_ref - pdot) + self._F_O
        hessian_F = at_ref.hessian_times(F, self._F_assist)
        K_q, B_q, D, D_B = gains.gains(at_ref, hessian_F)
        tau_ff = self._F_O @ at_ref.J + self._F_assist @ at_ref.J_harness
        # with F for F_O: what the feedback adds is of second order, 0.4 N m at 30 ms in a push
        dtau_ff = hessian_F @ v_ref + at_ref.J_harness[2] * assist_rate
        e_q, e_v = q_ref - q, v_ref - v
        tau_coupled = K_q @ e_q - D * e_q + B_q @ e_v - D_B * e_v
        return LawOutput(
            q_ref,
            v_ref,
            tau_ff,
            dtau_ff,
            tau_coupled,
            D,
            D_B,
            measured.p.copy(),
            pdot,
            p_ref,
            measured.closure.copy(),
            self._assist,
            result.iterations,
            result.residual,
        )

    def _align(self, q: Array, assist: float) -> None:
        if not self._aligned:
            # a planner that takes over from HOLD finds the assist in HOLD's feedforward
            self._assist = min(self._assist_max, max(0.0, assist))
        self._aligned = True
        self._p_C0 = self._measured.p * self._S_perp
        self._since_align_s = 0.0
        self._ik.q[:] = q

    def _closed_loop_reference(self, dt: float) -> tuple[Array, Array]:
        """Return p_C and its rate: from where `align` found the robot to zero, min-jerk."""
        self._since_align_s += dt
        s = min(1.0, self._since_align_s / self._recentre_s)
        left = 1.0 - s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
        rate = -30.0 * s * s * (1.0 - s) * (1.0 - s) / self._recentre_s
        return self._p_C0 * left, self._p_C0 * rate

    def _advance_assist(self, wanted: float, dt: float) -> float:
        """Move the assist towards what is wanted; return its rate in N/s."""
        wanted = min(self._assist_max, max(0.0, wanted))
        change_max = self._assist_rate_max * dt
        change = min(change_max, max(-change_max, wanted - self._assist))
        self._assist += change
        return change / dt if dt > 0.0 else 0.0
