"""Breaks down one planner tick into gains, margins, and each joint's torque by origin. Pure.

It runs the law of the planner's tick (`LawAtReference`). Here the law's inputs come from the log:
the joints, the references and the assist (docs/law.md).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from services.planner.law.certificate import Weakest, motor_mean
from services.planner.law.coupling import LawAtReference
from services.planner.law.feet import up_of
from services.planner.law.kinematics import Kinematics, Measured
from services.planner.law.reference import Reference
from services.planner.law.split import GainLaw, GainSplit, LocalGains
from shared.arrays import Array
from shared.bus.messages import AS_CONFIGURED, Pair, Vector6
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.exceptions import RunError
from shared.joints import N_LEG, SIDES
from tools.lab.design.push_limit import LoadedStand, PushLimits, limits_at

SINGULAR: Final = 1e-3
"""Minimum singular value of a leg's Jacobian, m and rad mixed, for which gains exist: a knee bent
by half a degree."""


class TorqueBreakdown(NamedTuple):
    """Breakdown of one tick; torques (12,) in N m, poses (6,) in m and rad."""

    p: Array
    """Measured pose."""
    pdot: Array
    p_ref: Array
    F: Array
    """K_p (p_ref - p) + B_p (pdot_ref - pdot) + F_O (6,), N and N m."""
    singular_values: Array
    """Singular values of J (6,); m and rad are mixed."""
    K_q: Array
    """(12, 12) N m/rad."""
    B_q: Array
    """(12, 12) N m s/rad."""
    local: LocalGains
    weakest: Weakest
    """Weakest direction with the joint services alone."""
    weakest_onboard: Weakest
    """Weakest direction with the drives alone."""
    pushes: dict[str, PushLimits]
    """The largest constant push along each direction, without assist."""
    gravity: Array
    assist: Array
    local_pd: Array
    coupled: Array
    """Torque that the planner adds, before its low-pass."""
    filtered: Array
    """Change of the coupled torque by its low-pass, plus the integral F_I and the easing of the
    operator's lead. Zero here: `xrl log explain` computes it from the recorded commands."""

    @property
    def total(self) -> Array:
        """Torque requested from the joints at command age zero (12,), N m."""
        return self.gravity + self.assist + self.local_pd + self.coupled + self.filtered


def torque_breakdown(
    config: RobotConfig,
    q: Array,
    v: Array,
    q_ref: Array,
    v_ref: Array,
    assist: float,
    slope: Pair = (0.0, 0.0),
    stance: Vector6 = AS_CONFIGURED,
) -> TorqueBreakdown:
    """Return the breakdown of a tick.

    Joint angles and their references (12,) are in rad, rates in rad/s. Assist, N, the floor's slope
    along x and y, rad, and the stance (right foot relative to the left, m and rad) are those that
    the planner used.

    Raises:
        ConfigError: the gain split needs a schedule, and the robot's is missing or stale.
        RunError: the pose is singular: a leg is straight, or the legs turn the torso opposite ways.
    """
    measured, reference = Measured(config), Reference(config)
    measured.stance[:] = reference.inputs.stance[:] = stance
    measured.update(q, v)
    law, split = GainLaw(config), GainSplit(config)
    up = np.array(up_of(slope))
    F_O, F_assist = np.zeros(6), assist * up
    F_O[:3] = config.total_mass * GRAVITY * up
    reference.load(np.zeros(6), F_O, F_assist, np.zeros(3), measured.D_left)
    reference.evaluate(q_ref)
    at_ref = reference.kinematics()
    _require_bent(at_ref)
    if not np.isfinite(reference.J).all():
        raise RunError(
            "singular pose: the two legs turn the torso in opposite directions, so its orientation "
            "is undefined; the angles of both legs must agree"
        )
    hessian_weight = at_ref.hessian_times(F_O, np.zeros(3)).copy()
    e_p, e_pdot = reference.p - measured.p, reference.J @ v_ref - measured.pdot
    terms = LawAtReference(law, split).evaluate(reference, e_p, e_pdot)
    body, local, certificate = terms.body_gains(), terms.local, split.certificate
    stand = LoadedStand(config, at_ref, reference.T, hessian_weight)
    return TorqueBreakdown(
        p=measured.p,
        pdot=measured.pdot,
        p_ref=reference.p,
        F=law.K_p * e_p + law.B_p * e_pdot + F_O,
        singular_values=np.asarray(np.linalg.svd(reference.J, compute_uv=False), float),
        K_q=body.K_q,
        B_q=body.B_q,
        local=local,
        weakest=certificate.weakest(local.D),
        weakest_onboard=certificate.weakest(motor_mean(local.D)),
        pushes=limits_at(stand, config, local.D, local.D_B),
        gravity=reference.gravity,
        assist=reference.assist,
        local_pd=local.D * (q_ref - q) + local.D_B * (v_ref - v),
        coupled=terms.coupled,
        filtered=np.zeros(12),
    )


def _require_bent(kinematics: Kinematics) -> None:
    for side, C in zip(SIDES, (kinematics.C[:, :N_LEG], kinematics.C[:, N_LEG:]), strict=True):
        smallest = float(np.linalg.svd(C, compute_uv=False)[-1])
        if not smallest >= SINGULAR:
            raise RunError(
                f"singular pose: the {side} leg is straight, or its hip or ankle is turned by 90 "
                f"degrees; its Jacobian's smallest singular value is {smallest:.1g}, but must be "
                f"at least {SINGULAR:g}: bend the knee"
            )
