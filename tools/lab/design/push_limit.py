"""Computes the largest constant push before a sole tips, a motor saturates or a foot slides. Pure.

The stiffness certificate (`services.planner.law.certificate`) is linear and has no limits. This
module adds them, for a constant horizontal push F u at the torso's origin:

1. Limit of the gains. The local gains D hold with constant references; while the planner is
   engaged, K_c acts too (`services.planner.law.coupling`). Body and torques change by dp, dtau:

       (K_fail + K_c) dp = F pi,   pi = (dr_torso/dp)^T u,   dtau = -D T dp - J^T K_c dp

   While led, a slowly growing push of up to `law.push_integral_max` leaves no error along y.

2. Limit of the body, under any control, at fixed joint angles. A linear program chooses how the
   two legs share weight and push. No gains withstand a larger push at that pose.

Leg i carries the torso wrench W_i: tau_i = J_i^T W_i + the torque of its knee's weight. Its sole
carries W_i moved to the ankle, plus the leg's weight. A push changes W_i by dW_i, with
J_i^T dW_i = dtau_i - (H T dp)_i. Every limit is linear in tau and in the soles' wrenches, so the
first limit that is reached sets the force.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from services.planner.law.certificate import motor_mean
from services.planner.law.coupling import PushIntegral, UncoupledGains, Y
from services.planner.law.kinematics import Kinematics
from services.planner.law.split import GainLaw
from shared.arrays import Array
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.extras import late
from shared.joints import MODULES, N_JOINTS, N_LEG, SIDES
from shared.robot.robot_model import ankle_positions
from tools.lab.design.poses import Poses

optimize, transform = late("scipy.optimize"), late("scipy.spatial.transform")

FRICTION: Final = 0.5
"""Friction coefficient of the soles on a slippery floor."""
DIRECTIONS: Final = {"forwards": (1.0, 0.0), "back": (-1.0, 0.0), "sideways": (0.0, 1.0)}
"""World x and y of each push. Left and right are symmetric."""
RIGID: Final = 1e9
"""N/m; models an integral, which leaves no error."""
_SLOPE_MIN: Final = 1e-12
_LEGS: Final = (slice(0, N_LEG), slice(N_LEG, N_JOINTS))


class _PushLimit(NamedTuple):
    """The largest push along one direction."""

    force_n: float
    """0 if the robot cannot hold the pose even without a push."""
    part: str
    """The limit reached first, such as "left sole's outer edge"."""


class PushLimits(NamedTuple):
    """The largest constant push along one direction, for each set of active controllers."""

    led: _PushLimit
    """TRACK: joint services and planner; the push grows slowly."""
    held: _PushLimit
    """HOLD: joint services only; the planner is dead."""
    drives: _PushLimit
    """Drives only; the joint services are dead too."""
    body: _PushLimit
    """Limit of soles and motors under any control."""


class Response(NamedTuple):
    """Change caused by a push of 1 N, after the body has come to rest."""

    dp: Array
    """(6,) m and rad."""
    dtau: Array
    """(12,) joint torques, N m."""
    soles: Array
    """(12,): force and moment at each ankle, N and N m, right leg first."""


class _Limit(NamedTuple):
    """Linear limit row @ (tau, soles) <= bound.

    `tau` (12,) is in N m; `soles` (12,) holds force and moment at each ankle, N and N m.
    """

    part: str
    row: Array
    bound: float


class LoadedStand:
    """Torques and wrenches of one pose under the robot's weight, and their change with a push."""

    def __init__(self, config: RobotConfig, kinematics: Kinematics, T: Array, H: Array) -> None:
        """Compute the loads of the pose at which the kinematics was updated.

        T (12, 6) are joint rates per unit of p along the closed chain. H (12, 12), N m/rad, is
        `Kinematics.hessian_times` of the weight.
        """
        self._T, self._H = T.copy(), H.copy()
        self._K_geo: Array = self._T.T @ self._H @ self._T
        self._J_body = kinematics.J.copy()
        C = kinematics.C
        self._J = (-C[:, :N_LEG], C[:, N_LEG:].copy())
        """Torso twist per joint rate of each leg (6, 6), linear before angular."""
        D_left = kinematics.D_left
        weight = config.torso_mass * GRAVITY
        rotation_world_torso = transform.Rotation.from_euler("ZXY", kinematics.p[[5, 3, 4]])
        arm_x, arm_y, _ = rotation_world_torso.apply(config.torso_com)
        torso = np.array([0.0, 0.0, weight, weight * arm_y, -weight * arm_x, 0.0])
        self._W = [shares @ torso for shares in (np.eye(6) - D_left, D_left)]
        """Torso wrench on each leg (6,), N and N m at the torso's origin."""
        F_O = np.zeros(6)
        F_O[2] = config.total_mass * GRAVITY
        self._tau: Array = F_O @ kinematics.J
        self._tau_knees = self._tau - self._joint_torques(self._W)
        """Torques of the knees' own weight (12,), N m."""
        ankles = ankle_positions(config) + np.outer((0.5, -0.5), kinematics.stance[:3])
        self._arms = [kinematics.r_torso - ankle for ankle in ankles]
        self._leg_weights = [
            # the moment of the knee's weight at the ankle equals the ankle torques that carry it
            np.array([0.0, 0.0, config.leg_weight, *self._tau_knees[leg][:2], 0.0])
            for leg in _LEGS
        ]
        self._limits = _limits(config)

    def along_p(self, gains: Array) -> Array:
        """Return T^T diag(gains) T (6, 6): the joint gains (12,) in the coordinates p."""
        return np.asarray((self._T.T * gains) @ self._T, float)

    def stiffness(self, D: Array) -> Array:
        """Return K_fail (6, 6) of local stiffnesses D (12,), N m/rad."""
        K = self.along_p(D) + self._K_geo
        return np.asarray(0.5 * (K + K.T), float)

    def response(
        self, D: Array, direction: tuple[float, float], K_c: Array | None = None
    ) -> Response | None:
        """Return the response to a constant push of 1 N, or None if the robot cannot stand.

        Args:
            D: local stiffnesses (12,), N m/rad. With drivetrain stiffness k, pass D k / (D + k).
            direction: world x and y, a unit vector.
            K_c: stiffness that the planner adds along p (6, 6); None if the planner is dead.
        """
        T = self._T
        K = self.stiffness(D) + (0.0 if K_c is None else K_c)
        if np.linalg.eigvalsh(K)[0] <= 0.0:
            return None
        torso_per_p = self._J[0][:2] @ T[:N_LEG]
        dp: Array = np.asarray(np.linalg.solve(K, torso_per_p.T @ np.array(direction)), float)
        dq = T @ dp
        dtau: Array = np.asarray(-D * dq, float)
        if K_c is not None:
            dtau -= self._J_body.T @ (K_c @ dp)
        dtau_wrench = dtau - self._H @ dq
        dW: list[Array] = [
            np.asarray(np.linalg.solve(J.T, dtau_wrench[leg]), float)
            for J, leg in zip(self._J, _LEGS, strict=True)
        ]
        soles = self._soles(dW) - np.concatenate(self._leg_weights)
        torso_shift = (self._J[0] @ dq[_LEGS[0]])[:3]
        for leg, W in enumerate(self._W):  # the torso's weight moves with the torso
            soles[6 * leg + 3 : 6 * leg + 6] += np.cross(torso_shift, W[:3])
        return Response(dp, dtau, soles)

    def limit_held(
        self, D: Array, direction: tuple[float, float], K_c: Array | None = None
    ) -> _PushLimit:
        """Return the largest constant push that the gains hold; arguments as for `response`."""
        response = self.response(D, direction, K_c)
        return self._hardest(response, np.zeros(2 * N_JOINTS))

    def limit_led(
        self, D: Array, direction: tuple[float, float], K_c: Array, integral_max: float
    ) -> _PushLimit:
        """Return the largest slowly growing push that gains and integral hold.

        Arguments as for `response`; `integral_max` is the limit of F_I, N, 0 without F_I
        (`services.planner.law.coupling`).
        """
        rigid = np.zeros((6, 6))
        rigid[Y, Y] = RIGID
        response = self.response(D, direction, K_c + rigid)
        if not (direction[Y] and integral_max) or response is None:
            return self.limit_held(D, direction, K_c)
        until_n = integral_max / abs(RIGID * response.dp[Y])
        hardest = self._hardest(response, np.zeros(2 * N_JOINTS))
        if hardest.force_n <= until_n:
            return hardest
        borne = until_n * np.concatenate((response.dtau, response.soles))
        beyond = self._hardest(self.response(D, direction, K_c), borne)
        return beyond._replace(force_n=until_n + beyond.force_n)

    def _hardest(self, response: Response | None, borne: Array) -> _PushLimit:
        """Return the largest push that torques and soles carry on top of the load `borne` (24,)."""
        if response is None:
            return _PushLimit(0.0, "the stiffness")
        before = borne + np.concatenate((self._tau, self._soles(self._W)))
        per_newton = np.concatenate((response.dtau, response.soles))
        hardest = _PushLimit(math.inf, "nothing")
        for part, row, bound in self._limits:
            slope = float(row @ per_newton)
            if slope > _SLOPE_MIN:
                force = max(0.0, (bound - float(row @ before)) / slope)
                hardest = min(hardest, _PushLimit(force, part))
        return hardest

    def limit_of_body(self, direction: Sequence[float], limp: str = "") -> _PushLimit:
        """Return the largest push that soles and motors withstand at this pose under any control.

        The direction is world x and y, a unit vector; or a wrench on the torso (6,), N and N m, and
        the limit is then a multiple of it. The motors of the module `limp` have no torque.
        """
        total, unit = self._W[0] + self._W[1], np.pad(direction, (0, 6 - len(direction)))

        def loads(x: Array) -> Array:
            """Return (tau, soles); the right leg carries x[:6], the push is x[6] in N."""
            W = [x[:6], total - x[6] * unit - x[:6]]
            return np.concatenate((self._joint_torques(W) + self._tau_knees, self._soles(W)))

        unpushed = loads(np.zeros(7))
        slopes = np.array([loads(e) - unpushed for e in np.eye(7)]).T
        rows = np.array([limit.row for limit in self._limits])
        limp_rows = np.array([limit.part == f"torque of {limp}" for limit in self._limits])
        bounds = np.where(limp_rows, 0.0, [limit.bound for limit in self._limits]) - rows @ unpushed
        solution = optimize.linprog(
            -np.eye(7)[6],
            A_ub=rows @ slopes,
            b_ub=bounds,
            bounds=[(None, None)] * 6 + [(0.0, None)],
        )
        if not solution.success:
            return _PushLimit(0.0, "the pose itself")
        left = np.where(limp_rows, np.inf, bounds - rows @ slopes @ solution.x)
        tightest = int(np.argmin(left))
        return _PushLimit(float(solution.x[6]), self._limits[tightest].part)

    def _joint_torques(self, W: list[Array]) -> Array:
        """Return the joint torques (12,), N m, that carry the torso's wrench on each leg."""
        return np.concatenate([J.T @ wrench for J, wrench in zip(self._J, W, strict=True)])

    def _soles(self, W: list[Array]) -> Array:
        """Return both soles' wrenches (12,), N and N m at the ankles."""
        wrenches = []
        for wrench, arm, leg_weight in zip(W, self._arms, self._leg_weights, strict=True):
            moment = wrench[3:] + np.cross(arm, wrench[:3])
            wrenches.append(np.concatenate((wrench[:3], moment)) + leg_weight)
        return np.concatenate(wrenches)


def stand_at(config: RobotConfig, poses: Poses, z: float, pitch: float) -> LoadedStand | None:
    """Return the stand at a COM height, m, and a pitch, rad, or None if out of reach."""
    node = poses.node(z, pitch)
    if node is None:
        return None
    return LoadedStand(config, poses.kinematics, node.T, node.hessians[0])


def limits_at(
    stand: LoadedStand, config: RobotConfig, D: Array, D_B: Array
) -> dict[str, PushLimits]:
    """Return the limits along each of `DIRECTIONS`; arguments as for `limits_along`."""
    return {
        name: limits_along(stand, config, D, D_B, direction)
        for name, direction in DIRECTIONS.items()
    }


def limits_along(
    stand: LoadedStand, config: RobotConfig, D: Array, D_B: Array, direction: tuple[float, float]
) -> PushLimits:
    """Return the limits along one direction, on rigid joints.

    D, N m/rad, and D_B, N m s/rad, (12,) are the local gains in TRACK.
    """
    body, schedule = GainLaw(config), config.gain_schedule
    damping = 0.0 if schedule is None else schedule.coupling_damping
    uncoupled = UncoupledGains(body.K_p, body.B_p, body.S, damping)
    K_c, _ = uncoupled.at(stand.stiffness(D), stand.along_p(D_B))
    D_hold = np.maximum(D, np.ravel([config.hold_gains(module)[0] for module in MODULES]))
    return PushLimits(
        stand.limit_led(D, direction, K_c, PushIntegral(config.law).most),
        stand.limit_held(D_hold, direction),
        stand.limit_held(motor_mean(D_hold), direction),
        stand.limit_of_body(direction),
    )


def _limits(config: RobotConfig) -> list[_Limit]:
    """Return the limits of every motor pair, sole edge and sole friction."""
    limits: list[_Limit] = []

    def add(part: str, bound: float, *entries: tuple[int, float]) -> None:
        row = np.zeros(24)
        for column, value in entries:
            row[column] = value
        limits.append(_Limit(part, row, bound))

    for index, module in enumerate(MODULES):
        for phi in (-1.0, 1.0):
            for theta in (-1.0, 1.0):
                most = config.joint.tau_module_max
                add(f"torque of {module}", most, (2 * index, phi), (2 * index + 1, theta))
    geometry = config.geometry
    l_x, l_y, h = geometry.l_foot / 2, geometry.w_foot / 2, geometry.foot_height
    for leg, side in enumerate(SIDES):
        f_x, f_y, f_z, m_x, m_y = (N_JOINTS + 6 * leg + part for part in range(5))
        outer = -1.0 if side == "right" else 1.0
        for sign, edge in ((1.0, "toe"), (-1.0, "heel")):
            # centre of pressure: x = (-m_y - h f_x) / f_z
            add(f"{side} sole's {edge}", 0.0, (m_y, -sign), (f_x, -sign * h), (f_z, -l_x))
        for sign, edge in ((outer, "outer edge"), (-outer, "inner edge")):
            # centre of pressure: y = (m_x - h f_y) / f_z
            add(f"{side} sole's {edge}", 0.0, (m_x, sign), (f_y, -sign * h), (f_z, -l_y))
        for axis in (f_x, f_y):
            for sign in (1.0, -1.0):
                # a square inside the friction cone
                least = -FRICTION / math.sqrt(2.0)
                add(f"{side} sole's friction", 0.0, (axis, sign), (f_z, least))
    return limits
