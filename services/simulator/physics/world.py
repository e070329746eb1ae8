"""The physical world in MuJoCo: the robot on free feet, the operator, pushes, the hoist.

Steps the true robot (`services.simulator.physics.body`), and knows no robot file, bus or clock:
`step` takes motor torques and moves on by one time step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from services.simulator.physics.actuation import Actuation
from services.simulator.physics.body import Body
from services.simulator.physics.foot_placement import FootPlacement
from services.simulator.physics.hoist import Hoist
from services.simulator.physics.led_hand import LedHand
from services.simulator.physics.operator import HandForce, Operator, Wearer
from services.simulator.physics.posture import as_vector, measure_posture
from services.simulator.physics.soles import sole_loads
from shared.bus.messages import HandLead, SimTruth, Vector3, Vector4
from shared.config.scenarios import Lead, Scenario, lead, push_at
from shared.extras import late

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = late("mujoco")

Array = NDArray[np.float64]


class World:
    """The simulated robot and what acts on it."""

    def __init__(self, body: Body, scenario: Scenario, lifted: float = 0.0) -> None:
        """Put the robot at its stand height, held by the hoist.

        Args:
            body: the true robot.
            scenario: what happens.
            lifted: the hoist holds it this much higher, m; 0: the soles rest on the floor.
        """
        self._scenario = scenario
        self.model = body.model
        self.data = mujoco.MjData(self.model)
        self.timestep = body.timestep
        self._steps = body.steps
        self.operator = Operator(body.hand, body.harness_point)
        self._wearer = Wearer(body.person)
        self._placement = FootPlacement(self.model, self.data, body)
        self._q_index, self._v_index = self._placement.q_index, self._placement.v_index
        self._actuation = Actuation(body, self.model.opt.timestep)
        self._joint_damping = self.model.dof_damping[self._v_index].copy()
        self._torso = self.model.body("torso").id
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
        self._torso_com: list[float] = self.model.body_ipos[self._torso].tolist()
        self._hoist = Hoist(body.weight, body.hoist_s)
        self.time = 0.0
        self._start_time = math.inf
        self._fallen = False
        self._hand_on = scenario.hand
        self.hand = HandForce(0.0, 0.0)
        self.load_n = 0.0
        self.asked: tuple[float, Vector4] | None = None
        """Assist, N, and shift that somebody asks for in place of the scenario."""
        self.led_hand: LedHand | None = None
        """The hand that somebody leads in place of the scenario."""
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
        # the hoist hangs from above: on a slope it holds the torso aside of the floor's normal
        self._placement.stand_up(body.stand_q, self._lean)
        self._actuation.settle(self.data.qpos[self._q_index])
        self.data.qpos[2] += lifted
        self._hoist.position = self.data.qpos[:3].copy()

    def stand_at(self, q: Array) -> None:
        """Stand the robot still, soles flat, at joint angles q (12,), rad; no hoist.

        The two legs must agree on the torso, as `InverseKinematics` makes them.
        """
        self._placement.stand_at(q)
        self._actuation.settle(self.data.qpos[self._q_index])
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
        actuation = self._actuation
        if actuation.flexible is not None:
            return actuation.encoders(actuation.flexible.theta, actuation.flexible.rate)
        return actuation.encoders(self._qpos.take(self._q_index), self._qvel.take(self._v_index))

    def torso_against_gravity(self) -> list[float]:
        """Return the quaternion (w, x, y, z) that turns torso axes into axes whose z is up."""
        measured = np.zeros(4)
        mujoco.mju_mulQuat(measured, self._level, self._qpos[3:7])
        quaternion: list[float] = measured.tolist()
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
        if self.led_hand is not None:
            wanted = self.led_hand.over(wanted)
        return wanted if self.asked is None else Lead(*wanted[:4], *self.asked)

    def take_hand(self, asked: HandLead) -> None:
        """Let somebody lead the hand from where it is, or push."""
        if self.led_hand is None:
            self.led_hand = LedHand()
        self.led_hand.take(asked, self.lead())

    def _apply_outside_forces(self) -> None:
        """Set the wrench on the torso: hand, load, push and hoist.

        In plain numbers: this runs at every step, and numpy's calls on three numbers
        would cost more than the physics.
        """
        t = self.scenario_s
        if self.led_hand is not None:
            self.led_hand.advance(self._dt)
        wanted = self.lead()
        r = self._torso_rotation.tolist()  # row by row
        x, y, z = self._harness_point
        arm_x = r[0] * x + r[1] * y + r[2] * z
        arm_y = r[3] * x + r[4] * y + r[5] * z
        # MuJoCo applies outside forces at the body's centre of mass, which a plant may move
        x, y, z = self._torso_com
        com_x = r[0] * x + r[1] * y + r[2] * z
        com_y = r[3] * x + r[4] * y + r[5] * z
        x, y, z = self._harness_point
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
        if self.led_hand is not None:
            self.push = self.led_hand.push or self.push
        f, m = self.hand.force_z - self.load_n, self.hand.moment_pitch
        # in torso axes, as the harness sensor feels it: f along world z, m about torso y
        self.harness_force = (r[6] * f, r[7] * f, r[8] * f)
        self.harness_moment = (0.0, m, 0.0)
        wrench = self._torso_wrench
        wrench[:] = (
            self.push[0],
            self.push[1],
            self.push[2] + f,
            r[1] * m + (arm_y - com_y) * f,
            r[4] * m - (arm_x - com_x) * f,
            r[7] * m,
        )
        if self._hoist.share > 0.0:
            rotation = self.data.xmat[self._torso].reshape(3, 3)
            hoist = self._hoist.advance(self._qpos[:3], rotation, self._torso_rates, self._dt)
            hoist[3:] -= np.cross(rotation @ self._torso_com, hoist[:3])
            wrench += hoist

    def truth(self, t_ns: int, real_time_factor: float, late_s: float) -> SimTruth:
        """Return the world as it is, for the log and the verdict."""
        placement = self._placement
        posture = measure_posture(self.data, self._torso, placement.feet, placement.ankles)
        self._fallen |= posture.fallen
        moment = self.data.xmat[self._torso].reshape(3, 3)[:, 1] * self.hand.moment_pitch
        right, left = sole_loads(self.model, self.data, placement.feet)
        self._truths += 1
        return SimTruth(
            t_ns=t_ns,
            seq=self._truths,
            scenario_s=self.scenario_s,
            com=posture.com,
            torso=posture.torso,
            angles=posture.angles,
            operator_force=(0.0, 0.0, self.hand.force_z),
            operator_moment=as_vector(moment),
            load_n=self.load_n,
            harness_force_z=self.load_n - self.hand.force_z,
            push=self.push,
            foot_right_tilt=posture.tilts[0],
            foot_left_tilt=posture.tilts[1],
            feet_slip=posture.slip,
            hoist=self._hoist.share,
            fallen=self._fallen,
            real_time_factor=real_time_factor,
            late_s=late_s,
            lean=self._lean,
            foot_right_force=right.force,
            foot_left_force=left.force,
            foot_right_cop=right.cop,
            foot_left_cop=left.cop,
        )


def _turn_between(start: Array, end: Array) -> Array:
    """Return the quaternion (w, x, y, z) of the shortest turn of one direction into another."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    turn = np.concatenate(([1.0 + a @ b], np.cross(a, b)))
    return np.asarray(turn / np.linalg.norm(turn), float)
