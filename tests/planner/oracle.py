"""Forward kinematics and statics straight from the paper's equations (section IV).

Plain numpy and the configuration's numbers; nothing of the code under test, so that an
agreement means something. Each leg is taken on its own, from its foot up, as the paper
writes it: R_torso = prod over (ankle, knee, hip) of Rx(phi) Ry(theta).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from shared.arrays import Array
from shared.config.robot_config import RobotConfig

GRAVITY = 9.81
RIGHT, LEFT = 0, 1
LEG = (slice(0, 6), slice(6, 12))
"""Where a leg's joints stand in q."""


class Leg(NamedTuple):
    """One leg at a configuration, world axes."""

    ankle: Array
    knee: Array
    torso: Array
    """The torso's origin as this leg carries it, m."""
    R: Array
    """Torso's rotation as this leg carries it (3, 3)."""


def rx(angle: float) -> Array:
    """Return an active rotation about x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def ry(angle: float) -> Array:
    """Return an active rotation about y: z turns towards x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def rz(angle: float) -> Array:
    """Return an active rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def leg(config: RobotConfig, side: int, q: Array) -> Leg:
    """Return one leg: ankle to knee l2, knee to hip l1, hip to torso centre w_hip / 2."""
    geometry = config.geometry
    y = -1.0 if side == RIGHT else 1.0
    phi_a, theta_a, phi_k, theta_k, phi_h, theta_h = q[LEG[side]]
    ankle = np.array([0.0, y * geometry.w_base / 2, 0.0])
    R = rx(phi_a) @ ry(theta_a)
    knee = ankle + R @ np.array([0.0, 0.0, geometry.l2])
    R = R @ rx(phi_k) @ ry(theta_k)
    hip = knee + R @ np.array([0.0, 0.0, geometry.l1])
    R = R @ rx(phi_h) @ ry(theta_h)
    return Leg(ankle, knee, hip - R @ np.array([0.0, y * geometry.w_hip / 2, 0.0]), R)


def masses(config: RobotConfig) -> tuple[float, float]:
    """Return (m_torso, m_total) of the paper, kg."""
    mass = config.mass
    m_torso = 2 * mass.module + 2 * mass.battery + mass.payload
    return m_torso, m_torso + 4 * mass.module


def mass_centre(config: RobotConfig, one: Leg) -> Array:
    """Return the torso's centre of mass, m: modules and batteries at its origin, payload beside."""
    place = np.array(config.mass.payload_com)
    return one.torso + one.R @ (config.mass.payload * place) / masses(config)[0]


def com(config: RobotConfig, q: Array, torso: Array) -> Array:
    """Return r_COM (paper's equation) for a torso centre given, m."""
    m_torso, m_total = masses(config)
    legs = [leg(config, side, q) for side in (RIGHT, LEFT)]
    at_joints = sum((one.knee + one.ankle for one in legs), np.zeros(3))
    return np.asarray((m_torso * torso + config.mass.module * at_joints) / m_total, float)


def euler(R: Array) -> Array:
    """Return (phi, theta, psi) of R = Rz(psi) Rx(phi) Ry(theta), rad.

    The paper prints R transposed; its formulas index (2,3), (1,3), (3,3), (2,1), (2,2).
    """
    Rt = R.T
    return np.array(
        [np.arcsin(Rt[1, 2]), np.arctan2(-Rt[0, 2], Rt[2, 2]), np.arctan2(-Rt[1, 0], Rt[1, 1])]
    )


def pose(config: RobotConfig, q: Array, side: int = RIGHT) -> Array:
    """Return p (6,) with the torso as one leg carries it: exact where the legs agree."""
    one = leg(config, side, q)
    return np.concatenate([com(config, q, mass_centre(config, one)), euler(one.R)])


def rotation_vector(R: Array) -> Array:
    """Return the rotation vector of a rotation by less than pi / 2."""
    axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.linalg.norm(axis))
    scale = float(np.arcsin(sine)) / sine if sine > 1e-12 else 1.0
    return np.asarray(scale * axis, float)


def closure(config: RobotConfig, q: Array) -> Array:
    """Return left minus right estimate of the torso (6,): m, and a rotation vector, world."""
    right, left = leg(config, RIGHT, q), leg(config, LEFT, q)
    return np.concatenate([left.torso - right.torso, rotation_vector(left.R @ right.R.T)])


def harness(config: RobotConfig, q: Array, side: int = RIGHT) -> Array:
    """Return the harness point as one leg carries it, m."""
    one = leg(config, side, q)
    return np.asarray(one.torso + one.R @ np.array(config.geometry.harness_point), float)


def derivative(f: Callable[[Array], Array], q: Array, step: float = 1e-6) -> Array:
    """Return df/dq by central differences, the joint last."""
    columns = [(f(q + e) - f(q - e)) / (2 * step) for e in step * np.eye(len(q))]
    return np.stack(columns, axis=-1)


def precise_derivative(f: Callable[[Array], Array], q: Array, step: float = 3e-3) -> Array:
    """Return df/dq as `derivative` does, to 1e-12 of f's size: differences of sixth order."""
    columns = []
    for e in step * np.eye(len(q)):
        near, mid, far = (f(q + n * e) - f(q - n * e) for n in (1, 2, 3))
        columns.append((45.0 * near - 9.0 * mid + far) / (60.0 * step))
    return np.stack(columns, axis=-1)


def second_derivative(f: Callable[[Array], Array], p: Array, step: float) -> Array:
    """Return d2f/dp2 (..., n, n) by central differences."""
    n = len(p)
    e = step * np.eye(n)
    middle = f(p)
    up, down = [f(p + row) for row in e], [f(p - row) for row in e]
    result = np.zeros((*np.shape(middle), n, n))
    for i in range(n):
        result[..., i, i] = up[i] - 2.0 * middle + down[i]
        for j in range(i):
            same = f(p + e[i] + e[j]) + f(p - e[i] - e[j])
            # the corners less what the axes alone curve by
            mixed = 0.5 * (same + 2.0 * middle - up[i] - down[i] - up[j] - down[j])
            result[..., i, j] = result[..., j, i] = mixed
    return result / step**2


def closed_chain(config: RobotConfig, q_near: Array) -> Callable[[Array], Array]:
    """Return q(p) for p near that of q_near, exact to rounding: Newton, its slope held.

    The legs agree in all that it returns; it refuses p that is too far away.
    """

    def rows(q: Array) -> Array:
        return np.concatenate([pose(config, q), closure(config, q)])

    inverse = np.linalg.inv(precise_derivative(rows, q_near))

    def q_of(p: Array) -> Array:
        q, wanted = q_near.copy(), np.concatenate([p, np.zeros(6)])
        for _ in range(40):
            step = inverse @ (wanted - rows(q))
            q += step
            if np.abs(step).max() < 1e-14:
                break
        assert np.abs(wanted - rows(q)).max() < 1e-13, "p is too far from q_near"
        return q

    return q_of


def leg_jacobian(config: RobotConfig, side: int, q: Array) -> Array:
    """Return the leg's torso twist per joint rate (6, 6), linear first, world axes."""
    R0 = leg(config, side, q).R

    def place(q_near: Array) -> Array:
        near = leg(config, side, q_near)
        return np.concatenate([near.torso, rotation_vector(near.R @ R0.T)])

    return derivative(place, q)[:, LEG[side]]


def knee_jacobian(config: RobotConfig, side: int, q: Array) -> Array:
    """Return the knee's velocity per joint rate of its leg (3, 6), world axes."""
    return derivative(lambda near: leg(config, side, near).knee, q)[:, LEG[side]]


def feasible(config: RobotConfig, q: Array) -> Array:
    """Return T (12, 6): joint rates per unit of p along which the legs stay together."""
    J = precise_derivative(lambda near: pose(config, near), q)
    C = precise_derivative(lambda near: closure(config, near), q)
    return np.asarray(np.linalg.solve(np.vstack([J, C]), np.eye(12)[:, :6]), float)


def potential_energy(config: RobotConfig, q: Array) -> float:
    """Return m g z_COM in J, the torso in the middle of what the legs say."""
    torso = 0.5 * sum(mass_centre(config, leg(config, side, q)) for side in (RIGHT, LEFT))
    return masses(config)[1] * GRAVITY * float(com(config, q, torso)[2])


def torso_wrench(config: RobotConfig, side: int, q: Array, tau: Array) -> Array:
    """Return the wrench (6,) that a leg gives the torso at rest under joint torques (12,).

    Virtual work on the leg, its knee module's weight included: J_i^T w + J_knee^T m g z
    = tau_i; force first, moment about the torso's centre.
    """
    weight = np.array([0.0, 0.0, config.mass.module * GRAVITY])
    on_torso = tau[LEG[side]] - knee_jacobian(config, side, q).T @ weight
    return np.asarray(np.linalg.solve(leg_jacobian(config, side, q).T, on_torso), float)


def foot_wrench(config: RobotConfig, side: int, q: Array, tau: Array) -> Array:
    """Return the wrench (6,) of the floor on a foot at rest, moment about the ankle."""
    one = leg(config, side, q)
    on_torso = torso_wrench(config, side, q, tau)
    weight = np.array([0.0, 0.0, config.mass.module * GRAVITY])
    force = on_torso[:3] + 2 * weight  # knee and ankle modules hang on this leg
    moment = (
        on_torso[3:]
        + np.cross(one.torso - one.ankle, on_torso[:3])
        + np.cross(one.knee - one.ankle, weight)
    )
    return np.concatenate([force, moment])
