"""The physical world in MuJoCo: the robot on free feet, the operator, pushes, the hoist.

Steps the true robot (`services.simulator.body`), and knows no robot file, bus or clock: `step`
takes motor torques and moves on by one time step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from services.simulator.actuation import Actuation
from services.simulator.body import Body
from services.simulator.hoist import Hoist
from services.simulator.operator import HandForce, Operator, Wearer
from shared.bus.messages import SimTruth, Vector3, Vector4
from shared.config.scenarios import Lead, Scenario, lead, push_at
from shared.robot.joints import JOINTS, N_LEG, SIDES

Array = NDArray[np.float64]

FALLEN_HEIGHT: Final = 0.60
"""m; a crawl goes down to 0.79."""
FALLEN_ANGLE: Final = 0.6
"""rad of roll or yaw."""
FALLEN_TILT: Final = 0.6
"""rad of a sole against the floor."""
STAND_ITERATIONS: Final = 8
"""Newton steps from `stand_pose` to soles that are flat to rounding."""


class World:
    """The simulated robot and what acts on it."""

    def __init__(self, body: Body, scenario: Scenario) -> None:
        """Put the robot on its feet at the stand height, held by the hoist."""
        self._scenario = scenario
        self.model = body.model
        self.data = mujoco.MjData(self.model)
        self.timestep = body.timestep
        self._steps = body.steps
        self.operator = Operator(body.hand, body.harness_point)
        self._wearer = Wearer(body.person)
        joints = [self.model.joint(name) for name in JOINTS]
        self._q_index = np.array([joint.qposadr[0] for joint in joints])
        self._v_index = np.array([joint.dofadr[0] for joint in joints])
        self._actuation = Actuation(body, self.model.opt.timestep)
        self._joint_damping = self.model.dof_damping[self._v_index].copy()
        self._torso = self.model.body("torso").id
        self._feet = [self.model.body(f"foot_{side}").id for side in SIDES]
        data = self.data  # views of its memory: to ask it for an array costs a microsecond
        self._qpos, self._qvel, self._applied = data.qpos, data.qvel, data.qfrc_applied
        self._torso_rotation, self._torso_wrench = (
            data.xmat[self._torso],
            data.xfrc_applied[self._torso],
        )
        self._torso_rates = data.qvel[:6]
        self._damping = self.model.dof_damping
        self._dt: float = self.model.opt.timestep
        self._harness_point = body.harness_point
        self._ankles_wanted, self._foot_yaws = body.ankles, body.foot_yaws
        self._hoist = Hoist(body.weight, body.hoist_s)
        self.time = 0.0
        self._start_time = math.inf
        self._fallen = False
        self._hand_on = scenario.hand
        self.hand = HandForce(0.0, 0.0)
        self.load_n = 0.0
        self.asked: tuple[float, Vector4] | None = None
        """Assist, N, and shift that somebody asks for in place of the scenario."""
        self.push: Vector3 = (0.0, 0.0, 0.0)
        self.harness_force: Vector3 = (0.0, 0.0, 0.0)
        """The operator's force on the torso at the harness point, N, torso axes."""
        self.harness_moment: Vector3 = (0.0, 0.0, 0.0)
        """N m, torso axes."""
        self._truths = 0
        self._level = _turn_between(-self.model.opt.gravity, np.array((0.0, 0.0, 1.0)))
        """Quaternion: turns the floor's axes into axes whose z is up."""
        x, y, z = self.model.opt.gravity.tolist()
        self._lean = (x / z, y / z)
        self._place(body)

    def _place(self, body: Body) -> None:
        """Stand the robot: soles flat, torso along the floor, COM over the ankles by gravity.

        The hoist hangs from above: on a slope it holds the torso aside of the floor's normal.
        """
        data, model = self.data, self.model
        data.qpos[self._q_index] = body.stand_q
        mujoco.mj_kinematics(model, data)
        data.qpos[0] -= data.xpos[self._feet[0]][0]
        self._flatten_soles()
        level = data.subtree_com[0][:2].copy()
        for _ in range(STAND_ITERATIONS if any(self._lean) else 0):
            com = data.subtree_com[0]  # the legs go less far than the torso
            data.qpos[:2] += level + np.array(self._lean) * com[2] - com[:2]
            self._flatten_soles()
        self._actuation.settle(data.qpos[self._q_index])
        self._hoist.position = data.qpos[:3].copy()

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
        self._actuation.settle(data.qpos[self._q_index])
        self.let_off_hoist()

    def go_on(
        self,
        qpos: Sequence[float],
        qvel: Sequence[float],
        warmstart: Sequence[float],
        scenario_s: float,
        hoist: float,
        hidden: Sequence[float],
    ) -> None:
        """Continue from the state of another world of the same robot, plant and scenario.

        Args:
            qpos: MuJoCo's position.
            qvel: its velocity.
            warmstart: its qacc_warmstart.
            scenario_s: scenario time; negative: it has not started.
            hoist: fraction of its support.
            hidden: as `hidden` returned it.
        """
        data = self.data
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos, qvel, warmstart
        if scenario_s >= 0.0:
            self._start_time = self.time - scenario_s
        self._hoist.go_on(hoist)
        kept = data.qacc_warmstart.copy()
        mujoco.mj_forward(self.model, data)
        data.qacc_warmstart[:] = kept
        self._wearer.go_on(*hidden[:3])
        self._actuation.restore(hidden[3:])

    def hidden(self) -> tuple[float, ...]:
        """Return what MuJoCo does not hold: the person, the drivetrain, torques on their way."""
        wearer = self._wearer
        return (wearer.above, wearer.rate, wearer.load_n, *self._actuation.state())

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
                r = _turned_back(r, self._foot_yaws[leg])
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

    @property
    def hoist(self) -> float:
        """Share of the hoist's support: 1 hanging, 0 free."""
        return self._hoist.share

    def let_off_hoist(self) -> None:
        """Take the hoist away at once."""
        self._hoist.share = 0.0

    def release_hoist(self) -> None:
        """Let the hoist down."""
        self._hoist.releasing = True

    def motor_turns(self) -> tuple[Array, Array]:
        """Return motor positions (12,) in turns and rates (12,) in turn/s.

        Order: axis0, axis1 of each module in `MODULES` order.
        """
        return self._actuation.encoders(
            self._qpos.take(self._q_index), self._qvel.take(self._v_index)
        )

    def torso_against_gravity(self) -> list[float]:
        """Return the quaternion (w, x, y, z) that turns torso axes into axes whose z is up."""
        told = np.zeros(4)
        mujoco.mju_mulQuat(told, self._level, self._qpos[3:7])
        quaternion: list[float] = told.tolist()
        return quaternion

    def torso_rates(self) -> list[float]:
        """Return the torso's angular velocity (3,), rad/s, torso axes."""
        rates: list[float] = self._torso_rates[3:].tolist()
        return rates

    def step(self, motor_torque: Array) -> None:
        """Move on by one time step under motor torques (12,) in N m."""
        actuation, v_index = self._actuation, self._v_index
        for _ in range(self._steps):
            q, v = self._qpos.take(self._q_index), self._qvel.take(v_index)
            self._applied[v_index] = actuation.torque(motor_torque, q, v)
            if actuation.flexible is not None:
                self._damping[v_index] = self._joint_damping + actuation.flexible.damping
            self._apply_outside_forces()
            mujoco.mj_step(self.model, self.data)
            self.time += self._dt

    def lead(self) -> Lead:
        """Return the operator's present request."""
        wanted = lead(self._scenario, self.scenario_s)
        return wanted if self.asked is None else Lead(*wanted[:4], *self.asked)

    def _apply_outside_forces(self) -> None:
        """Set the wrench on the torso: hand, load, push and hoist.

        In plain numbers: this runs at every step, and numpy's calls on three numbers
        would cost more than the physics.
        """
        t = self.scenario_s
        wanted = self.lead()
        r = self._torso_rotation.tolist()  # row by row
        x, y, z = self._harness_point
        arm_x = r[0] * x + r[1] * y + r[2] * z
        arm_y = r[3] * x + r[4] * y + r[5] * z
        self.hand = HandForce(0.0, 0.0)
        if self._hand_on and self._hoist.share == 0.0:
            height = float(self._qpos[2]) + r[6] * x + r[7] * y + r[8] * z
            _, _, v_z, w_x, w_y, w_z = self._torso_rates.tolist()  # omega in torso axes
            omega_x = r[0] * w_x + r[1] * w_y + r[2] * w_z
            omega_y = r[3] * w_x + r[4] * w_y + r[5] * w_z
            rate = v_z + omega_x * arm_y - omega_y * arm_x
            self._wearer.take_hold(height - wanted.height - z)
            above, rising = self._wearer.motion()
            height, rate = height - above, rate - rising
            self.hand = self.operator.force(wanted, height, rate, math.atan2(-r[6], r[8]), w_y)
        self._wearer.step(self._dt, self.hand.force_z, wanted.assist)
        self.load_n = self._wearer.load_n
        self.push = push_at(self._scenario, t) if t >= 0.0 else (0.0, 0.0, 0.0)
        f, m = self.hand.force_z - self.load_n, self.hand.moment_pitch
        # in torso axes, as the harness sensor feels it: f along world z, m about torso y
        self.harness_force = (r[6] * f, r[7] * f, r[8] * f)
        self.harness_moment = (0.0, m, 0.0)
        wrench = self._torso_wrench
        wrench[:] = (
            self.push[0],
            self.push[1],
            self.push[2] + f,
            r[1] * m + arm_y * f,
            r[4] * m - arm_x * f,
            r[7] * m,
        )
        if self._hoist.share > 0.0:
            rotation = self.data.xmat[self._torso].reshape(3, 3)
            wrench += self._hoist.advance(self._qpos[:3], rotation, self._torso_rates, self._dt)

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
            hoist=self._hoist.share,
            fallen=self._fallen,
            real_time_factor=real_time_factor,
            late_s=late_s,
            lean=self._lean,
        )


def _turned_back(rotation: Array, yaw: float) -> Array:
    """Return Rz(yaw)^T rotation: how a foot is turned against its place, small."""
    if yaw == 0.0:
        return rotation
    c, s = math.cos(yaw), math.sin(yaw)
    return np.asarray(np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation, float)


def _turn_between(start: Array, end: Array) -> Array:
    """Return the quaternion (w, x, y, z) of the shortest turn of one direction into another."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    turn = np.concatenate(([1.0 + a @ b], np.cross(a, b)))
    return np.asarray(turn / np.linalg.norm(turn), float)


def _vector(values: Array) -> Vector3:
    return float(values[0]), float(values[1]), float(values[2])
