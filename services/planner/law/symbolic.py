"""Kinematics as expression graphs, built once and evaluated without Python in between.

The CasADi graphs contain the equations of docs/law.md#load-sharing. Both legs are products of
exponentials, and the load-sharing matrices D mix their estimates of the torso's pose. p, its
Jacobian and the Hessian term of K_q follow. With NumPy, whose calls on 3-vectors cost more than
their arithmetic, a planner tick took 0.5 ms alone, and 1.5 ms beside the fleet's other processes on
two cores.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import casadi as ca
import numpy as np

from services.planner.law.model import LegGeometry
from shared.config.robot_config import RobotConfig
from shared.joints import N_JOINTS, N_LEG

DAMPING: Final = 1e-4
"""Levenberg damping of the closed chain's system; bounds the step where the legs are nearly
singular."""


class Graphs(NamedTuple):
    """Functions of the law; `services.planner.law.kinematics` documents their results."""

    sharing: ca.Function
    """(q, stance) -> D_L (6, 6), the left leg's load share; the right leg's is I - D_L."""
    pose: ca.Function
    """(q, stance, D_L) -> p, closure, J, C, J_harness, r_torso, r_harness."""
    hessian: ca.Function
    """(q, stance, D_L, F, F_harness) -> sum_i H_i F_i (12, 12), plus the term of F_harness."""
    stance: ca.Function
    """q -> stance (6,) in which the legs agree, as in `Kinematics`."""
    measured: ca.Function
    """(q, v, stance) -> D_L, p, closure, J, C, J_harness, pdot; per leg, the row (2, 6) that maps
    its torques to its upward force, and its Jacobian's determinant (2,), m^3."""
    reference: ca.Function
    """(q, stance, D_L, p_ref, pdot_ref, F_O, F_assist, F_assist rate, lower and upper joint limits)
    -> the law's quantities at the reference pose (`services.planner.law.reference`)."""


class _Foot(NamedTuple):
    """Pose of a foot, world axes."""

    r: ca.SX
    """Ankle (3,), m."""
    rotation: ca.SX
    """Rotation relative to the robot file's foot (3, 3)."""


class _Leg(NamedTuple):
    """One leg at q; twists are of the torso, about its origin, world axes."""

    rotation: ca.SX
    r_torso: ca.SX
    r_knee: ca.SX
    J_ang: ca.SX
    J_lin: ca.SX
    J_knee: ca.SX


def build(config: RobotConfig, geometry: tuple[LegGeometry, LegGeometry]) -> Graphs:
    """Return the graphs for a robot."""
    q, stance = ca.SX.sym("q", N_JOINTS), ca.SX.sym("s", 6)
    D_left = ca.SX.sym("D_L", 6, 6)
    feet = _feet(geometry, stance)
    legs = _chains(geometry, feet, q)
    pose = _pose(config, legs, D_left)
    F, F_harness = ca.SX.sym("F", 6), ca.SX.sym("F_h", 3)
    sharing = ca.Function("sharing", [q, stance], [_left_load_share(config, feet, legs)])
    at_pose = ca.Function(
        "pose", [q, stance, D_left], [ca.densify(part) for part in pose[:7]], {"cse": True}
    )
    hessian = ca.Function(
        "hessian",
        [q, stance, D_left, F, F_harness],
        [ca.densify(_hessian(config, legs, D_left, pose, F, F_harness))],
        {"cse": True},
    )
    return Graphs(
        sharing=sharing,
        pose=at_pose,
        hessian=hessian,
        stance=ca.Function("stance", [q], [_stance(geometry, q)], {"cse": True}),
        measured=_measured(sharing, at_pose),
        reference=_reference(at_pose, hessian),
    )


def _measured(sharing: ca.Function, pose: ca.Function) -> ca.Function:
    """Return the graph of a tick's kinematics at the measured joints.

    It calls the other graphs, because the code of one flat expression is slow in a cold cache.
    """
    q, v, stance = ca.MX.sym("q", N_JOINTS), ca.MX.sym("v", N_JOINTS), ca.MX.sym("s", 6)
    D_left = sharing(q, stance)
    p, closure, J, C, J_harness, _, _ = pose(q, stance, D_left)
    leg = _upward_force()
    (right, det_right), (left, det_left) = leg(-C[:, :N_LEG]), leg(C[:, N_LEG:])
    return ca.Function(
        "measured",
        [q, v, stance],
        [
            D_left, p, closure, J, C, J_harness, J @ v,
            ca.horzcat(right, left).T, ca.vertcat(det_right, det_left),
        ],
    )  # fmt: skip


def _upward_force() -> ca.Function:
    """Return J_leg (6, 6) -> x (6,), |det J_leg|: the leg's upward force on the torso is x . tau.

    J_leg^T W = tau, so W_z is the third row of J_leg^-T: J_leg x = unit z.
    """
    J_leg = ca.SX.sym("J", N_LEG, N_LEG)
    Q, R = ca.qr(J_leg)
    x = ca.solve(R, Q[2, :].T)
    determinant = ca.fabs(R[0, 0])
    for i in range(1, N_LEG):
        determinant *= ca.fabs(R[i, i])
    return ca.Function("upward_force", [J_leg], [ca.densify(x), determinant], {"cse": True})


def _reference(pose: ca.Function, hessian: ca.Function) -> ca.Function:
    """Return the graph of the law's quantities at the reference pose.

    It makes one Gauss-Newton step, damped as in `InverseKinematics.solve_rates`. The same
    decomposition solves T = [J; C]^-1 [I; 0], which gives v_ref: docs/law.md (8).
    """
    q, stance, D_left = ca.MX.sym("q", N_JOINTS), ca.MX.sym("s", 6), ca.MX.sym("D_L", 6, 6)
    p_ref, pdot_ref, F_O = ca.MX.sym("p", 6), ca.MX.sym("pdot", 6), ca.MX.sym("F_O", 6)
    F_assist, assist_rate = ca.MX.sym("F_a", 3), ca.MX.sym("Fdot_a", 3)
    low, high = ca.MX.sym("low", N_JOINTS), ca.MX.sym("high", N_JOINTS)
    p, closure, J, C, J_harness, _, _ = pose(q, stance, D_left)
    error = ca.vertcat(p_ref - p, -closure)
    unit_p = ca.densify(ca.vertcat(ca.DM.eye(6), ca.DM(6, 6)))
    A = ca.vertcat(J, C)
    normal = A.T @ A + DAMPING**2 * ca.DM.eye(N_JOINTS)
    solved = ca.solve(normal, A.T @ ca.horzcat(error, unit_p), "ldl")
    step, T = solved[:, 0], solved[:, 1:]
    q_ref, v_ref = q + step, T @ pdot_ref
    beyond = ca.mmax(ca.vertcat(low - q_ref, q_ref - high))
    H = hessian(q, stance, D_left, F_O, F_assist)
    return ca.Function(
        "reference",
        [q, stance, D_left, p_ref, pdot_ref, F_O, F_assist, assist_rate, low, high],
        [
            q_ref, ca.vertcat(ca.mmax(ca.fabs(step)), beyond), T, v_ref, p, J, J_harness, H,
            J.T @ F_O, J_harness.T @ F_assist, H @ v_ref + J_harness.T @ assist_rate,
        ],
    )  # fmt: skip


def _feet(geometry: tuple[LegGeometry, LegGeometry], stance: ca.SX) -> list[_Foot]:
    """Return both feet; each moves by half of the stance, so the origin is midway between them."""
    return [
        _Foot(ca.DM(leg.r_foot) + half * stance[:3], _rotation(half * stance[3:]))
        for leg, half in zip(geometry, (0.5, -0.5), strict=True)
    ]


def _chains(geometry: tuple[LegGeometry, LegGeometry], feet: list[_Foot], q: ca.SX) -> list[_Leg]:
    return [
        _chain(leg, foot, q[i * N_LEG : (i + 1) * N_LEG])
        for i, (leg, foot) in enumerate(zip(geometry, feet, strict=True))
    ]


def _stance(geometry: tuple[LegGeometry, LegGeometry], q: ca.SX) -> ca.SX:
    """Return the stance in which both legs carry the torso to the same pose.

    With the ankles f_i as in the robot file, leg i carries it to (R_i, x_i). The feet are then
    rotated by +-phi/2 and shifted by +-d/2:

        Rot(phi) = R_L R_R^T
        f_R + d/2 + Rot(phi/2) (x_R - f_R) = f_L - d/2 + Rot(-phi/2) (x_L - f_L)

    The result is NaN for a rotation beyond 90 degrees, which is no stance.
    """
    right, left = _chains(geometry, _feet(geometry, ca.SX.zeros(6)), q)
    turn = left.rotation @ right.rotation.T
    phi = ca.if_else(ca.trace(turn) > 1.0, _rotation_vector(turn), ca.DM.nan(3, 1))
    at_right, at_left = (
        ca.DM(leg.r_foot) + _rotation(half * phi) @ (chain.r_torso - ca.DM(leg.r_foot))
        for leg, chain, half in zip(geometry, (right, left), (0.5, -0.5), strict=True)
    )
    return ca.densify(ca.vertcat(at_left - at_right, phi))


def _chain(geometry: LegGeometry, foot: _Foot, q: ca.SX) -> _Leg:
    """Return knee, torso and Jacobians of one leg: docs/law.md (1) as a product of exponentials."""
    rotation = foot.rotation
    shift = foot.r - rotation @ ca.DM(geometry.r_foot)
    axes, points = [], []
    r_knee = ca.SX.zeros(3)
    for joint in range(N_LEG):
        axis, point = ca.DM(np.round(geometry.axes[joint], 12)), ca.DM(geometry.points[joint])
        axes.append(rotation @ axis)
        points.append(rotation @ point + shift)
        turn = _rodrigues(axis, q[joint])
        shift = shift + rotation @ (point - turn @ point)
        rotation = rotation @ turn
        if joint == 1:
            r_knee = rotation @ ca.DM(geometry.r_knee) + shift
    r_torso = rotation @ ca.DM(geometry.r_torso) + shift
    J_lin = [ca.cross(a, r_torso - point) for a, point in zip(axes, points, strict=True)]
    J_knee = [
        ca.cross(a, r_knee - point) if joint < 2 else ca.SX(3, 1)
        for joint, (a, point) in enumerate(zip(axes, points, strict=True))
    ]
    return _Leg(
        rotation, r_torso, r_knee, ca.horzcat(*axes), ca.horzcat(*J_lin), ca.horzcat(*J_knee)
    )


class _Pose(NamedTuple):
    p: ca.SX
    closure: ca.SX
    J: ca.SX
    C: ca.SX
    J_harness: ca.SX
    r_torso: ca.SX
    r_harness: ca.SX
    E_inverse: ca.SX
    rotation: ca.SX
    arm_com: ca.SX | None
    """From the torso's origin to its centre of mass, world; None if both coincide."""


def _pose(config: RobotConfig, legs: list[_Leg], D_left: ca.SX) -> _Pose:
    """Mix the legs' estimates of the torso by D; build p, J, closure: docs/law.md (5), (15)."""
    right, left = legs
    closure = ca.vertcat(
        left.r_torso - right.r_torso, _rotation_vector(left.rotation @ right.rotation.T)
    )
    towards_left = D_left.T @ closure
    rotation = _rotation(towards_left[3:]) @ right.rotation
    r_torso = right.r_torso + towards_left[:3]
    twists = [ca.vertcat(leg.J_lin, leg.J_ang) for leg in legs]
    J_torso = ca.horzcat((ca.SX.eye(6) - D_left).T @ twists[0], D_left.T @ twists[1])
    torso_fraction = config.torso_mass / config.total_mass
    knee_fraction = config.mass.module / config.total_mass
    r_com = torso_fraction * r_torso + knee_fraction * (right.r_knee + left.r_knee)
    J_com = torso_fraction * J_torso[:3, :] + knee_fraction * ca.horzcat(right.J_knee, left.J_knee)
    arm_com = None
    if any(config.torso_com):
        arm_com = rotation @ ca.DM(config.torso_com)
        r_com += torso_fraction * arm_com
        J_com -= torso_fraction * ca.skew(arm_com) @ J_torso[3:, :]
    angles = _angles(rotation)
    E_inverse = _angle_rates_from_omega(angles[0], angles[2])
    arm = rotation @ ca.DM(config.geometry.harness_point)
    return _Pose(
        p=ca.vertcat(r_com, angles),
        closure=closure,
        J=ca.vertcat(J_com, E_inverse @ J_torso[3:, :]),
        C=ca.horzcat(-twists[0], twists[1]),
        J_harness=J_torso[:3, :] - ca.skew(arm) @ J_torso[3:, :],
        r_torso=r_torso,
        r_harness=r_torso + arm,
        E_inverse=E_inverse,
        rotation=rotation,
        arm_com=arm_com,
    )


def _hessian(
    config: RobotConfig, legs: list[_Leg], D_left: ca.SX, pose: _Pose, F: ca.SX, F_harness: ca.SX
) -> ca.SX:
    """Return d(J^T F + J_harness^T F_harness)/dq, symmetric, block diagonal: docs/law.md (20).

    Each leg's share of the wrench is constant. A change of the sharing with q only moves forces
    between the legs; these do no work along the closed chain. For joint j below joint k,
    dJ_k/dq_j = a_j x J_k and da_k/dq_j = a_j x a_k. For a moment, the symmetric part is the second
    derivative with respect to the torso's rotation vector. Automatic differentiation gives the
    curvature of the angles and of the arm to the harness point over that rotation; half of it is
    added to each leg. Along the closed chain (J T = I, C T = 0) T^T H T is then exact:
    -F . d2q/dp2.
    """
    torso_fraction = config.torso_mass / config.total_mass
    knee_force = config.mass.module / config.total_mass * F[:3]
    force = torso_fraction * F[:3] + F_harness
    moment = pose.E_inverse.T @ F[3:] + ca.cross(pose.r_harness - pose.r_torso, F_harness)
    if pose.arm_com is not None:
        moment += torso_fraction * ca.cross(pose.arm_com, F[:3])
    wrench = ca.vertcat(force, moment)
    left_share = D_left @ wrench
    by_rotation = _by_rotation(config, pose.rotation, F, F_harness)
    blocks = []
    for leg, leg_wrench in zip(legs, (wrench - left_share, left_share), strict=True):
        block = ca.SX.zeros(N_LEG, N_LEG)
        for k in range(N_LEG):
            for j in range(k + 1):
                a_j = leg.J_ang[:, j]
                value = ca.dot(ca.cross(leg_wrench[:3], a_j), leg.J_lin[:, k])
                if k < 2:
                    value += ca.dot(ca.cross(knee_force, a_j), leg.J_knee[:, k])
                if j < k:
                    value += 0.5 * ca.dot(ca.cross(leg_wrench[3:], a_j), leg.J_ang[:, k])
                block[j, k] = block[k, j] = value
        blocks.append(block + 0.5 * leg.J_ang.T @ by_rotation @ leg.J_ang)
    return ca.diagcat(*blocks)


def _by_rotation(config: RobotConfig, rotation: ca.SX, F: ca.SX, F_harness: ca.SX) -> ca.SX:
    """Return the Hessian (3, 3), over a small rotation, of the work of F and F_harness.

    The work is moment . angles + F_harness . arm, plus the torso's share of the force times its
    centre of mass.
    """
    turn = ca.SX.sym("turn", 3)
    turned = _rotation(turn) @ rotation
    arm = turned @ ca.DM(config.geometry.harness_point)
    work = ca.dot(F[3:], _angles(turned)) + ca.dot(F_harness, arm)
    if any(config.torso_com):
        fraction = config.torso_mass / config.total_mass
        work += fraction * ca.dot(F[:3], turned @ ca.DM(config.torso_com))
    return ca.substitute(ca.hessian(work, turn)[0], turn, ca.SX.zeros(3))


def _left_load_share(config: RobotConfig, feet: list[_Foot], legs: list[_Leg]) -> ca.SX:
    """Return D_L (6, 6), the left leg's share of a torso wrench: docs/law.md (14).

    Leg i applies the wrench X_i w_i to the torso, with w_i at its foot. W makes foot moments
    costly, because a sole tips beyond a lever of a few centimetres. The least-effort distribution
    of a torso wrench F is w_i = W X_i^T A^-1 F, with A = sum X_i W X_i^T. Leg i's share at the
    torso is therefore D_i = X_i W X_i^T A^-1. Moments are in the foot's axes.
    """
    middle = 0.5 * (legs[0].r_torso + legs[1].r_torso)
    if config.law.jacobian == "average":
        return ca.densify(0.5 * ca.SX.eye(6) + 0 * middle[0])
    fraction_x, fraction_y, l_z = config.law.load_sharing_moment_arms
    l_x = fraction_x * config.geometry.l_foot / 2
    l_y = fraction_y * config.geometry.w_foot / 2
    # the sole's width bears a moment about x, its length one about y
    W = ca.diag(ca.DM([1.0, 1.0, 1.0, l_y**2, l_x**2, l_z**2]))
    weighted = []
    for foot in feet:
        X = ca.SX.eye(6)
        X[3:, :3] = ca.skew(foot.r - middle)
        X[3:, 3:] = foot.rotation
        weighted.append(X @ W @ X.T)
    # both are symmetric: (A^-1 B)^T = B A^-1
    return ca.densify(ca.solve(weighted[0] + weighted[1], weighted[1]).T)


def _rodrigues(axis: ca.DM, angle: ca.SX) -> ca.SX:
    k = ca.sparsify(ca.skew(axis))
    return ca.SX.eye(3) + ca.sin(angle) * k + (1 - ca.cos(angle)) * ca.sparsify(k @ k)


def _angles(rotation: ca.SX) -> ca.SX:
    """Return (roll, pitch, yaw) of R = Rz(yaw) Rx(roll) Ry(pitch), rad: docs/law.md (2)."""
    return ca.vertcat(
        ca.asin(rotation[2, 1]),
        ca.atan2(-rotation[2, 0], rotation[2, 2]),
        ca.atan2(-rotation[0, 1], rotation[1, 1]),
    )


def _angle_rates_from_omega(roll: ca.SX, yaw: ca.SX) -> ca.SX:
    """Return E^-1 (3, 3): (roll, pitch, yaw) rates = E^-1 omega, omega in world axes.

    R = Rz(yaw) Rx(roll) Ry(pitch), so omega = E rates with E = [Rz x, Rz Rx y, z]. This is the
    inverse of E in closed form, singular at roll = +-pi/2 only.
    """
    cf, sf, cp, sp = ca.cos(roll), ca.sin(roll), ca.cos(yaw), ca.sin(yaw)
    return ca.vertcat(
        ca.horzcat(cp, sp, 0),
        ca.horzcat(-sp / cf, cp / cf, 0),
        ca.horzcat(sp * sf / cf, -cp * sf / cf, 1),
    )


def _rotation_vector(rotation: ca.SX) -> ca.SX:
    """Return the rotation vector of a small rotation.

    While the planner is engaged, the legs disagree by far less than 0.2 rad. Up to there, the
    series of asin(s)/s is accurate to 2e-8 and, unlike the quotient, regular at zero. At 0.34 rad
    it is accurate to 2e-6.
    """
    axis = 0.5 * ca.vertcat(
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    )
    s2 = ca.dot(axis, axis)
    return axis * (1 + s2 / 6 + 3 * s2**2 / 40 + 15 * s2**3 / 336)


def _rotation(vector: ca.SX) -> ca.SX:
    """Return the rotation of a small rotation vector, by series that are regular at zero."""
    s2 = ca.dot(vector, vector)
    a = 1 - s2 / 6 + s2**2 / 120
    b = 0.5 - s2 / 24 + s2**2 / 720
    k = ca.skew(vector)
    return ca.SX.eye(3) + a * k + b * (k @ k)
