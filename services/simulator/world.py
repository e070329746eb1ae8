"""The physical world in MuJoCo: the robot on free feet, the operator, pushes, the hoist.

The only owner of MuJoCo. Knows no bus and no clock: `step` takes motor torques and moves
on by one time step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from services.simulator.operator import HandForce, Operator
from shared.config import GRAVITY, RobotConfig
from shared.joints import JOINTS, MODULES, N_LEG, SIDES
from shared.messages import SimTruth, Vector3
from shared.robot_model import ankle_positions, mjcf, stand_pose
from shared.scenario import Lead, Scenario, lead, push_at

Array = NDArray[np.float64]

FALLEN_HEIGHT: Final = 0.60
"""m; a crawl goes down to 0.79."""
FALLEN_ANGLE: Final = 0.6
"""rad of roll or yaw."""
FALLEN_TILT: Final = 0.6
"""rad of a sole against the floor."""
HOIST_STIFFNESS: Final = (2e4, 2e3)
"""N/m and N m/rad of the hoist while it holds the torso."""
HOIST_DAMPING: Final = (2e3, 2e2)
"""N s/m and N m s/rad."""
HOIST_WEIGHT_SHARE: Final = 0.75
"""Part of the weight the hoist takes: the soles stay on the floor."""
STAND_ITERATIONS: Final = 8
"""Newton steps from `stand_pose` to soles that are flat to rounding."""


class World:
    """The simulated robot and what acts on it."""

    def __init__(self, config: RobotConfig, scenario: Scenario) -> None:
        """Put the robot on its feet at the stand height, held by the hoist."""
        self._scenario = scenario
        self.model = mujoco.MjModel.from_xml_string(mjcf(config))
        self.data = mujoco.MjData(self.model)
        self.timestep: float = self.model.opt.timestep
        self._operator = Operator(config)
        self._weight = config.total_mass * GRAVITY
        joints = [self.model.joint(name) for name in JOINTS]
        self._q_index = np.array([joint.qposadr[0] for joint in joints])
        self._v_index = np.array([joint.dofadr[0] for joint in joints])
        signs = np.array(config.motor_signs())[:, None]
        motor = signs * _motor_from_joint(config.joint.gear_ratio)
        self._motor_from_q: Array = np.zeros((len(JOINTS), self.model.nq))
        self._motor_from_q[:, self._q_index] = motor
        self._motor_from_v: Array = np.zeros((len(JOINTS), self.model.nv))
        self._motor_from_v[:, self._v_index] = motor
        # power is the same on both sides: tau = (d motor angle / d joint angle)^T torque
        self._tau_from_motor: Array = 2.0 * math.pi * self._motor_from_v.T.copy()
        self._torso = self.model.body("torso").id
        self._feet = [self.model.body(f"foot_{side}").id for side in SIDES]
        self._harness_point = config.geometry.harness_point
        self._ankles_wanted = np.array(ankle_positions(config))
        self._hoist_time = config.simulation.hoist_s
        self.hoist = 1.0
        self._releasing = False
        self.time = 0.0
        self._start_time = math.inf
        self._fallen = False
        self._hand_on = scenario.hand
        self.hand = HandForce(0.0, 0.0)
        self.load_n = 0.0
        self.push: Vector3 = (0.0, 0.0, 0.0)
        self.harness_force: Vector3 = (0.0, 0.0, 0.0)
        """What the operator does to the torso at the harness point, N, torso axes."""
        self.harness_moment: Vector3 = (0.0, 0.0, 0.0)
        """N m, torso axes."""
        self._truths = 0
        self._place(config)

    def _place(self, config: RobotConfig) -> None:
        """Stand the robot: torso level at the stand height, soles flat, COM over the ankles."""
        data, model = self.data, self.model
        data.qpos[self._q_index] = stand_pose(config, config.simulation.stand_height)
        mujoco.mj_kinematics(model, data)
        data.qpos[0] -= data.xpos[self._feet[0]][0]
        self._flatten_soles()
        self._hoist_position = data.qpos[:3].copy()

    def stand_at(self, q: Array) -> None:
        """Stand the robot still, soles flat, at joint angles q (12,), rad; no hoist.

        The two legs must agree on the torso, as `InverseKinematics` makes them.
        """
        data = self.data
        data.qpos[:7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        data.qpos[self._q_index] = q
        mujoco.mj_kinematics(self.model, data)
        foot = self._feet[0]
        rotation_sole_torso = data.xmat[foot].reshape(3, 3).T.copy()
        data.qpos[:3] = self._ankles_wanted[0] - rotation_sole_torso @ data.xpos[foot]
        mujoco.mju_mat2Quat(data.qpos[3:7], rotation_sole_torso.ravel())
        data.qvel[:] = 0.0
        self._flatten_soles()
        self.hoist = 0.0

    def go_on(
        self,
        qpos: Sequence[float],
        qvel: Sequence[float],
        warmstart: Sequence[float],
        scenario_s: float,
        hoist: float,
    ) -> None:
        """Go on from the state of another world of the same robot and scenario.

        Args:
            qpos: MuJoCo's position.
            qvel: its velocity.
            warmstart: its qacc_warmstart.
            scenario_s: scenario time; negative: it has not begun.
            hoist: share of its support.
        """
        data = self.data
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos, qvel, warmstart
        if scenario_s >= 0.0:
            self._start_time = self.time - scenario_s
        self.hoist = hoist
        self._releasing = hoist < 1.0
        kept = data.qacc_warmstart.copy()
        mujoco.mj_forward(self.model, data)
        data.qacc_warmstart[:] = kept

    def _flatten_soles(self) -> None:
        """Move the legs until both ankles are in their places, soles flat."""
        data, model, wanted = self.data, self.model, self._ankles_wanted
        jacobian = np.zeros((6, model.nv))
        for _ in range(STAND_ITERATIONS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for leg, foot in enumerate(self._feet):
                columns = self._v_index[leg * N_LEG : (leg + 1) * N_LEG]
                mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], foot)
                r = data.xmat[foot].reshape(3, 3)
                turn = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
                error = np.concatenate((wanted[leg] - data.xpos[foot], -turn))
                step = np.linalg.solve(jacobian[:, columns], error)
                data.qpos[self._q_index[leg * N_LEG : (leg + 1) * N_LEG]] += step
        mujoco.mj_forward(model, data)
        self._ankles = np.array([data.xpos[foot] for foot in self._feet])

    @property
    def scenario(self) -> Scenario:
        """What happens."""
        return self._scenario

    @property
    def scenario_s(self) -> float:
        """Scenario time in s; negative before it starts."""
        return self.time - self._start_time if math.isfinite(self._start_time) else -1.0

    def start(self) -> None:
        """Let the scenario begin now."""
        self._start_time = self.time

    def let_go(self) -> None:
        """Let the operator take the hand off."""
        self._hand_on = False

    def release_hoist(self) -> None:
        """Let the hoist down."""
        self._releasing = True

    def motor_turns(self) -> tuple[Array, Array]:
        """Return motor positions (12,) in turns and rates (12,) in turn/s.

        Order: axis0, axis1 of each module in `MODULES` order.
        """
        data = self.data
        return (
            self._motor_from_q @ data.qpos,
            self._motor_from_v @ data.qvel,
        )

    def step(self, motor_torque: Array) -> None:
        """Move on by one time step under motor torques (12,) in N m."""
        data = self.data
        np.matmul(self._tau_from_motor, motor_torque, out=data.qfrc_applied)
        self._apply_outside_forces()
        mujoco.mj_step(self.model, data)
        self.time += self.timestep

    def lead(self) -> Lead:
        """Return what the operator wants now."""
        return lead(self._scenario, self.scenario_s)

    def _apply_outside_forces(self) -> None:
        """Set the wrench on the torso: hand, load, push and hoist.

        In plain numbers: this runs at every step, and numpy's calls on three numbers
        would cost more than the physics.
        """
        data = self.data
        t = self.scenario_s
        wanted = lead(self._scenario, t)
        r = data.xmat[self._torso].tolist()  # row by row
        x, y, z = self._harness_point
        arm_x = r[0] * x + r[1] * y + r[2] * z
        arm_y = r[3] * x + r[4] * y + r[5] * z
        self.hand = HandForce(0.0, 0.0)
        if self._hand_on and self.hoist == 0.0:
            height = float(data.qpos[2]) + r[6] * x + r[7] * y + r[8] * z
            _, _, v_z, w_x, w_y, w_z = data.qvel[:6].tolist()  # omega in torso axes
            omega_x = r[0] * w_x + r[1] * w_y + r[2] * w_z
            omega_y = r[3] * w_x + r[4] * w_y + r[5] * w_z
            rate = v_z + omega_x * arm_y - omega_y * arm_x
            self.hand = self._operator.force(wanted, height, rate, math.atan2(-r[6], r[8]), w_y)
        self.load_n = wanted.assist
        self.push = push_at(self._scenario, t) if t >= 0.0 else (0.0, 0.0, 0.0)
        f, m = self.hand.force_z - self.load_n, self.hand.moment_pitch
        # in torso axes, as the harness sensor feels it: f along world z, m about torso y
        self.harness_force = (r[6] * f, r[7] * f, r[8] * f)
        self.harness_moment = (0.0, m, 0.0)
        wrench = data.xfrc_applied[self._torso]
        wrench[:] = (
            self.push[0],
            self.push[1],
            self.push[2] + f,
            r[1] * m + arm_y * f,
            r[4] * m - arm_x * f,
            r[7] * m,
        )
        if self.hoist > 0.0:
            self._apply_hoist(wrench)

    def _apply_hoist(self, wrench: Array) -> None:
        """Hold the torso by a spring-damper and carry the weight, by the hoist's share."""
        if self._releasing:
            self.hoist = max(0.0, self.hoist - self.timestep / self._hoist_time)
        data = self.data
        rotation = data.xmat[self._torso].reshape(3, 3)
        k_lin, k_ang = HOIST_STIFFNESS
        b_lin, b_ang = HOIST_DAMPING
        error = self._hoist_position - data.qpos[:3]
        turn = 0.5 * np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        omega = rotation @ data.qvel[3:6]
        wrench[:3] += self.hoist * (k_lin * error - b_lin * data.qvel[:3])
        wrench[3:] += self.hoist * (-k_ang * turn - b_ang * omega)
        wrench[2] += self.hoist * HOIST_WEIGHT_SHARE * self._weight

    def truth(self, t_ns: int, real_time_factor: float, late_s: float) -> SimTruth:
        """Return the world as it is, for the log and the verdict."""
        data = self.data
        rotation = data.xmat[self._torso].reshape(3, 3)
        roll = math.asin(min(1.0, max(-1.0, rotation[2, 1])))
        pitch = math.atan2(-rotation[2, 0], rotation[2, 2])
        yaw = math.atan2(-rotation[0, 1], rotation[1, 1])
        tilts = [math.acos(min(1.0, data.xmat[foot][8])) for foot in self._feet]
        positions = np.array([data.xpos[foot] for foot in self._feet])
        slip = float(np.linalg.norm(positions - self._ankles, axis=1).max())
        torso, com = data.xpos[self._torso], data.subtree_com[0]
        self._fallen |= bool(
            torso[2] < FALLEN_HEIGHT
            or max(abs(roll), abs(yaw)) > FALLEN_ANGLE
            or max(tilts) > FALLEN_TILT
            or not np.isfinite(torso).all()
        )
        moment = rotation[:, 1] * self.hand.moment_pitch
        self._truths += 1
        return SimTruth(
            t_ns=t_ns,
            seq=self._truths,
            scenario_s=self.scenario_s,
            com=_vector(com),
            torso=_vector(torso),
            angles=(roll, pitch, yaw),
            operator_force=(0.0, 0.0, self.hand.force_z),
            operator_moment=_vector(moment),
            load_n=self.load_n,
            harness_force_z=self.load_n - self.hand.force_z,
            push=self.push,
            foot_right_tilt=tilts[0],
            foot_left_tilt=tilts[1],
            feet_slip=slip,
            hoist=self.hoist,
            fallen=self._fallen,
            real_time_factor=real_time_factor,
            late_s=late_s,
        )


def _motor_from_joint(gear_ratio: float) -> Array:
    """Return the differential (12, 12): motor turns from joint angles in rad.

    Per module, m1 = N (q_theta + q_phi), m2 = N (q_theta - q_phi), in turns.
    """
    pair = np.array([[1.0, 1.0], [-1.0, 1.0]]) * gear_ratio / (2.0 * math.pi)
    return np.asarray(np.kron(np.eye(len(MODULES)), pair), float)


def _vector(values: Array) -> Vector3:
    return float(values[0]), float(values[1]), float(values[2])
