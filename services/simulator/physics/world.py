"""The physical world in MuJoCo: the robot on free feet, and the forces on it.

It steps the true robot (`services.simulator.physics.body`) without a robot file, bus or clock:
`step` applies motor torques for one time step.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.simulator.physics.actuation import Actuation
from services.simulator.physics.body import Body, FootPlacement
from services.simulator.physics.operator import LedHand
from services.simulator.physics.outside import OutsideForces, Torso
from services.simulator.physics.posture import as_vector, measure_posture, sole_loads
from shared.arrays import Array
from shared.bus.messages import HandLead
from shared.bus.traces import SimState, SimTruth
from shared.config.scenarios import Lead, Scenario
from shared.extras import late
from shared.rounding import POSITION

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = late("mujoco")


class Joints(NamedTuple):
    """Views of the 12 joints in MuJoCo's memory, because each query costs a microsecond."""

    q_index: NDArray[np.intp]
    """Indices of the joint angles in qpos."""
    v_index: NDArray[np.intp]
    """Indices of the joint rates in qvel."""
    qpos: Array
    qvel: Array
    applied: Array
    """Applied torques, indexed by `v_index`, N m."""
    damping: Array
    """Damping, indexed by `v_index`, N m s/rad."""
    damping_alone: Array
    """Damping of the joints without their drivetrains (12,), N m s/rad."""


class World:
    """The simulated robot and the forces on it.

    Attributes:
        outside: external forces on the torso.
        joints: the joints in MuJoCo's memory.
        actuation: drivetrains and encoders.
        placement: solver that puts the feet at their positions.
        time: time since the start of the world, s.
    """

    def __init__(self, body: Body, scenario: Scenario, lifted: float = 0.0) -> None:
        """Put the robot at its stand height, held by the hoist.

        Args:
            body: the true robot.
            scenario: course of the run.
            lifted: height by which the hoist lifts the soles off the floor, m.
        """
        self.scenario = scenario
        self.model = model = body.model
        self.data = data = mujoco.MjData(model)
        self.timestep = body.timestep
        self._steps = body.plant.steps
        self._dt: float = model.opt.timestep
        self.placement = placement = FootPlacement(model, data, body)
        self.actuation = Actuation(body, self._dt)
        self.joints = Joints(
            q_index=placement.q_index,
            v_index=placement.v_index,
            qpos=data.qpos,
            qvel=data.qvel,
            applied=data.qfrc_applied,
            damping=model.dof_damping,
            damping_alone=model.dof_damping[placement.v_index].copy(),
        )
        self._torso_id = torso = model.body("torso").id
        self.time = 0.0
        self._start_time = math.inf
        self._fallen = False
        self._truths = 0
        self._level = _turn_between(-model.opt.gravity, np.array((0.0, 0.0, 1.0)))
        """Quaternion that rotates floor axes to axes with z up."""
        x, y, z = model.opt.gravity.tolist()
        self._lean = (x / z, y / z)
        # the hoist hangs vertically: on a slope the COM is off the floor's normal through the feet
        placement.stand_up(body.stand_q, self._lean)
        self.actuation.settle(data.qpos[placement.q_index])
        data.qpos[2] += lifted
        self._torso = Torso(
            position=data.qpos[:3],
            rotation=data.xmat[torso],
            rates=data.qvel[:6],
            wrench=data.xfrc_applied[torso],
            com=model.body_ipos[torso].tolist(),
        )
        self.outside = OutsideForces(body, scenario, self._torso)

    # ---- start and resume

    def stand_at(self, q: Array) -> None:
        """Place the robot at rest, soles flat, at joint angles q (12,), rad, without the hoist.

        Both legs must give the same torso pose; the angles of `InverseKinematics` do.
        """
        self.placement.stand_at(q)
        self.actuation.settle(self.data.qpos[self.joints.q_index])
        self.remove_hoist()

    def hidden(self) -> tuple[float, ...]:
        """Return the state outside MuJoCo: the person, the drivetrain, delayed torques."""
        wearer = self.outside.wearer
        person = wearer.above, wearer.rate, wearer.asked_n, wearer.reach
        return (*person, *self.actuation.numbers())

    def resume(self, state: SimState) -> None:
        """Continue from the state of another world of the same robot, plant and scenario."""
        data, outside = self.data, self.outside
        data.qpos[:], data.qvel[:] = state.qpos, state.qvel
        data.qacc_warmstart[:] = state.warmstart
        mujoco.mj_forward(self.model, data)
        data.qacc_warmstart[:] = state.warmstart
        if state.scenario_s >= 0.0:
            self._start_time = self.time - state.scenario_s
        outside.hoist.share, outside.hoist.releasing = state.hoist, state.hoist < 1.0
        wearer, numbers = outside.wearer, state.hidden
        wearer.above, wearer.rate, wearer.asked_n, wearer.reach = numbers[:4]
        wearer.holds = True
        self.actuation.set_numbers(numbers[4:])
        outside.led_hand = LedHand.of_numbers(state.hand) if any(state.hand) else None

    # ---- the scenario, the operator, the hoist

    @property
    def scenario_s(self) -> float:
        """Scenario time in s; negative before it starts."""
        return self.time - self._start_time if math.isfinite(self._start_time) else -1.0

    def start(self) -> None:
        """Start the scenario now."""
        self._start_time = self.time

    def lead(self) -> Lead:
        """Return the operator's present request."""
        return self.outside.lead(self.scenario_s)

    def take_hand(self, asked: HandLead) -> None:
        """Accept a request to lead the hand from its present position, or to push."""
        if self.outside.led_hand is None:
            self.outside.led_hand = LedHand()
        self.outside.led_hand.request(asked, self.lead())

    def let_go(self) -> None:
        """Take the operator's hand off the harness."""
        self.outside.holds = False

    @property
    def hoist(self) -> float:
        """Share of the hoist's support: 1 hanging, 0 free."""
        return self.outside.hoist.share

    def release_hoist(self) -> None:
        """Start to release the hoist."""
        self.outside.hoist.releasing = True

    def remove_hoist(self) -> None:
        """Remove the hoist at once."""
        self.outside.hoist.share = 0.0

    # ---- a step, and measurements between steps

    def step(self, motor_torque: Array) -> None:
        """Advance by one time step under motor torques (12,), N m.

        MuJoCo resets the robot to its start, without an error, when a force is not finite or the
        motion diverges; the robot then counts as fallen. A torque that is not finite acts as zero,
        because it would stay in the drivetrains' state.
        """
        actuation, joints = self.actuation, self.joints
        if not math.isfinite(motor_torque @ motor_torque):
            self._fallen = True
            motor_torque = np.where(np.isfinite(motor_torque), motor_torque, 0.0)
        q_index, v_index = joints.q_index, joints.v_index
        for _ in range(self._steps):
            q, v = joints.qpos.take(q_index), joints.qvel.take(v_index)
            joints.applied[v_index] = actuation.torque(motor_torque, q, v)
            if actuation.flexible is not None:
                joints.damping[v_index] = joints.damping_alone + actuation.flexible.damping
            self.outside.apply(self.scenario_s, self._dt)
            mujoco.mj_step(self.model, self.data)
            self.time += self._dt
            if self.data.time < self.time - self._dt:
                self._fallen = True

    def motor_turns(self) -> tuple[Array, Array]:
        """Return the encoders' positions (12,), turns, and the motors' rates (12,), turn/s.

        Order: axis0, axis1 of each module in `MODULES` order.
        """
        actuation, joints = self.actuation, self.joints
        if actuation.flexible is not None:
            return actuation.encoders(actuation.flexible.theta, actuation.flexible.rate)
        q, v = joints.qpos.take(joints.q_index), joints.qvel.take(joints.v_index)
        return actuation.encoders(q, v)

    def torso_against_gravity(self) -> list[float]:
        """Return the quaternion (w, x, y, z) that rotates torso axes to axes with z up."""
        measured = np.zeros(4)
        mujoco.mju_mulQuat(measured, self._level, self.joints.qpos[3:7])
        quaternion: list[float] = measured.tolist()
        return quaternion

    def torso_rates(self) -> list[float]:
        """Return the torso's angular velocity (3,), rad/s, torso axes."""
        rates: list[float] = self._torso.rates[3:].tolist()
        return rates

    def truth(self, t_ns: int, real_time_factor: float, late_s: float) -> SimTruth:
        """Return the true state of the world, for the log and the verdict."""
        placement, outside = self.placement, self.outside
        posture = measure_posture(self.data, self._torso_id, placement.feet, placement.ankles)
        self._fallen |= posture.fallen
        moment = self._torso.rotation.reshape(3, 3)[:, 1] * outside.hand.moment_pitch
        right, left = sole_loads(self.model, self.data, placement.feet)
        self._truths += 1
        truth = SimTruth(
            t_ns=t_ns,
            seq=self._truths,
            scenario_s=self.scenario_s,
            com=posture.com,
            torso=posture.torso,
            angles=posture.angles,
            operator_force=(outside.hand_ahead, outside.hand_side, outside.hand.force_z),
            operator_moment=as_vector(moment),
            load_n=outside.wearer.load_n,
            harness_force_z=outside.wearer.load_n - outside.hand.force_z,
            push=outside.push,
            foot_right_tilt=posture.tilts[0],
            foot_left_tilt=posture.tilts[1],
            feet_slip=posture.slip,
            hoist=outside.hoist.share,
            fallen=self._fallen,
            real_time_factor=real_time_factor,
            late_s=late_s,
            lean=self._lean,
            foot_right_force=right.force,
            foot_left_force=left.force,
            foot_right_cop=right.cop,
            foot_left_cop=left.cop,
            feet=posture.feet,
        )
        return _rounded(truth)


def _rounded(truth: SimTruth) -> SimTruth:
    """Return the truth with `POSITION` decimals in every number, also in those of vectors."""
    fields: dict[str, Any] = msgspec.structs.asdict(truth)
    for name, value in fields.items():
        if isinstance(value, float):
            fields[name] = round(value, POSITION)
        elif isinstance(value, tuple):
            fields[name] = tuple(round(number, POSITION) for number in value)
    return SimTruth(**fields)


def _turn_between(start: Array, end: Array) -> Array:
    """Return the quaternion (w, x, y, z) of the shortest rotation of `start` to `end`."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    turn = np.concatenate(([1.0 + a @ b], np.cross(a, b)))
    return np.asarray(turn / np.linalg.norm(turn), float)
