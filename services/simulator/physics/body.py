"""The true robot: the robot file with the plant's errors, placed on its feet.

The world steps this body and reads no robot file, so the truth may differ from a controller's model
in every number. The generated model (`shared.robot.robot_model`) is nominal; this module changes
its masses, friction, floor and feet.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from services.simulator.physics.plant import RIGID, PlantConfig
from shared.arrays import Array
from shared.bus.messages import Vector3
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.config.sections import OperatorConfig
from shared.extras import late
from shared.joints import JOINTS, MODULES, N_LEG, SIDES
from shared.robot.robot_model import ankle_positions, mjcf, stand_pose

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = late("mujoco")

MINOR_FRICTION = (0.005, 0.0001)
"""Torsional and rolling friction of a contact, m."""
STICTION_TIME = 0.004
"""Time constant of the friction between sole and floor, s: twice the minimum at a 1 ms step.

MuJoCo omits the term dJ/dt v from a contact's acceleration. A sole under a turning leg therefore
creeps, at the leg's centripetal acceleration times about half of this time. With 20 ms, as in the
contact's normal direction, the feet creep back by 1.9 mm per squat, at any time step and
`impratio`; with 4 ms, by 0.3 mm. `SimTruth.over` is therefore measured from the feet's present
position.
"""


ITERATIONS: Final = 8
"""Newton steps from `stand_pose` until the soles are flat to rounding errors."""
_PRESSED: Final = 1e-9
"""Depth of the soles in the floor at the start, m. At 0 the last bit would decide which of their
corners touch: four of eight on x86-64, all on Arm."""


class Body(NamedTuple):
    """The true robot and the operator behind its harness."""

    model: mujoco.MjModel
    timestep: float
    """Duration of one `World.step`, s; the model's own step is this divided by `plant.steps`."""
    weight: float
    """Weight of the robot, N."""
    stand_q: Array
    """Joint angles near the initial stand (12,), rad."""
    ankles: Array
    """Positions of the right and left ankle (2, 3), m."""
    foot_yaws: tuple[float, float]
    """rad"""
    harness_point: Vector3
    hoist_s: float
    hand: OperatorConfig
    motor_from_joint: Array
    """(12, 12) turns/rad, with the motors' signs."""
    counts_per_turn: int
    """Counts of an encoder per turn."""
    plant: PlantConfig


def body_of(config: RobotConfig, plant: PlantConfig) -> Body:
    """Return the true robot: the controllers' model with the plant's errors."""
    spec = mujoco.MjSpec.from_string(mjcf(config))
    spec.option.timestep = config.simulation.timestep / plant.steps
    # By default MuJoCo uses sparse matrices from 60 degrees of freedom on, and the sparse Newton
    # solver of 4.0.0 is wrong by up to 22 % on some trees (200 iterations, no warning).
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    _set_gravity(spec, plant)
    _set_masses(spec, config, plant)
    _set_joints(spec, plant)
    ankles, yaws = _feet(config, plant)
    _set_floor(spec, config, plant, ankles)
    model = spec.compile()
    signs = np.array(config.motor_signs())[:, None]
    return Body(
        model=model,
        timestep=config.simulation.timestep,
        weight=float(model.body_mass.sum()) * GRAVITY,
        stand_q=np.array(stand_pose(config, config.simulation.stand_height)),
        ankles=ankles,
        foot_yaws=yaws,
        harness_point=config.geometry.harness_point,
        hoist_s=config.simulation.hoist_s,
        hand=config.simulation.operator,
        motor_from_joint=signs * _motor_from_joint(config.joint.gear_ratio),
        counts_per_turn=config.joint.encoder_counts_per_turn,
        plant=plant,
    )


def _set_gravity(spec: mujoco.MjSpec, plant: PlantConfig) -> None:
    """Tilt gravity: on a floor that rises along x, it pulls the robot towards -x."""
    x, y = (math.sin(angle) for angle in plant.floor.slope)
    spec.option.gravity = [-GRAVITY * x, -GRAVITY * y, -GRAVITY * math.sqrt(1.0 - x * x - y * y)]


def _set_masses(spec: mujoco.MjSpec, config: RobotConfig, plant: PlantConfig) -> None:
    errors = plant.body
    torso = spec.body("torso")
    true = config.torso_mass + (errors.payload_scale - 1.0) * config.mass.payload
    scale = true / config.torso_mass
    torso.mass *= scale
    torso.inertia = torso.inertia * scale
    torso.ipos = torso.ipos + np.array(errors.com_offset)
    for body in spec.bodies:
        body.mass *= errors.mass_scale
        body.inertia = body.inertia * errors.mass_scale


def _set_joints(spec: mujoco.MjSpec, plant: PlantConfig) -> None:
    drivetrain = plant.drivetrain
    rigid = drivetrain.stiffness == RIGID
    friction, damping = drivetrain.joint_friction, drivetrain.joint_damping
    for name in JOINTS:
        joint = spec.joint(name)
        joint.armature = drivetrain.rotor_inertia if rigid else 0.0
        joint.frictionloss = friction + (drivetrain.motor_friction if rigid else 0.0)
        joint.damping[0] = damping + (drivetrain.motor_damping if rigid else 0.0)


def _feet(config: RobotConfig, plant: PlantConfig) -> tuple[Array, tuple[float, float]]:
    """Return the positions of the ankles (2, 3), m, and the yaws of the feet, rad.

    The origin is midway between the ankles in x and y, and at the left foot's height.
    """
    ankles = np.array(ankle_positions(config))
    half = 0.5 * (np.array(plant.feet.offset_right) - np.array(plant.feet.offset_left))
    ankles[:, :2] += (half[:2], -half[:2])
    ankles[SIDES.index("right"), 2] += plant.floor.step
    return ankles, (float(half[2]), float(-half[2]))


def _set_floor(spec: mujoco.MjSpec, config: RobotConfig, plant: PlantConfig, ankles: Array) -> None:
    floor = plant.floor
    grounds, soles = [spec.geom("floor")], [spec.geom(f"sole_{side}") for side in SIDES]
    step = floor.step
    if step != 0.0:
        # the lower foot stands on the plane, the higher one on a block
        low, high = (1, 0) if step > 0.0 else (0, 1)
        plane = grounds[0]
        plane.pos = [0.0, 0.0, float(ankles[low, 2]) - config.geometry.foot_height]
        top = float(ankles[high, 2]) - config.geometry.foot_height
        half = [0.5, 0.25, abs(step) / 2.0]
        block = spec.worldbody.add_geom(
            name="step", type=mujoco.mjtGeom.mjGEOM_BOX, size=half,
            pos=[float(ankles[high, 0]), float(ankles[high, 1]), top - half[2]],
        )  # fmt: skip
        grounds.append(block)
    for sole in soles:
        sole.contype = sole.conaffinity = 0  # only the pairs named here touch
        for ground in grounds:
            torsional, rolling = MINOR_FRICTION
            spec.add_pair(
                geomname1=ground.name, geomname2=sole.name, condim=sole.condim,
                friction=[floor.friction, floor.friction, torsional, rolling, rolling],
                solref=[floor.contact_time, 1.0], solreffriction=[STICTION_TIME, 1.0],
            )  # fmt: skip
    for ground in grounds:  # a fallen robot lies on its torso and thighs
        for name in ("torso", *(f"thigh_{side}" for side in SIDES)):
            spec.add_pair(
                geomname1=ground.name, geomname2=name, condim=3,
                friction=[floor.friction, floor.friction, 0.0, 0.0, 0.0],
            )  # fmt: skip


def _motor_from_joint(gear_ratio: float) -> Array:
    """Return the differential (12, 12): motor turns from joint angles in rad.

    Per module, m1 = N (q_theta + q_phi), m2 = N (q_theta - q_phi), in turns.
    """
    pair = np.array([[1.0, 1.0], [-1.0, 1.0]]) * gear_ratio / (2.0 * math.pi)
    return np.asarray(np.kron(np.eye(len(MODULES)), pair), float)


class FootPlacement:
    """Solver for the legs' joint angles that put the feet at their positions.

    Attributes:
        q_index: indices of the 12 joint angles in MuJoCo's qpos.
        v_index: indices of their rates in qvel.
        feet: MuJoCo's ids of the feet, by side.
        ankles: initial positions of the feet (2, 3), m; slip is measured from them.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, body: Body) -> None:
        """Bind MuJoCo's model and data, and the positions of the feet."""
        self._model, self._data = model, data
        joints = [model.joint(name) for name in JOINTS]
        self.q_index = np.array([joint.qposadr[0] for joint in joints])
        self.v_index = np.array([joint.dofadr[0] for joint in joints])
        self.feet = [model.body(f"foot_{side}").id for side in SIDES]
        self._wanted, self._yaws = body.ankles, body.foot_yaws
        self.ankles: Array = np.array(body.ankles)

    def stand_up(self, q: Array, lean: tuple[float, float]) -> None:
        """Place the robot, torso square to the floor, with the COM vertically above the ankles.

        The solver starts from joint angles q (12,), rad. `lean` is gravity's x and y divided by z.
        """
        data, model = self._data, self._model
        data.qpos[self.q_index] = q
        mujoco.mj_kinematics(model, data)
        data.qpos[0] -= data.xpos[self.feet[0]][0]
        self._flatten_soles()
        level = data.subtree_com[0][:2].copy()
        for _ in range(ITERATIONS if any(lean) else 0):
            com = data.subtree_com[0]  # the COM moves less than the torso
            data.qpos[:2] += level + np.array(lean) * com[2] - com[:2]
            self._flatten_soles()
        data.qpos[2] -= _PRESSED
        mujoco.mj_forward(model, data)

    def stand_at(self, q: Array) -> None:
        """Place the robot at rest at joint angles (12,), rad, as `World.stand_at` describes."""
        data = self._data
        data.qpos[:7] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
        data.qpos[self.q_index] = q
        mujoco.mj_kinematics(self._model, data)
        foot = self.feet[0]
        rotation_sole_torso = data.xmat[foot].reshape(3, 3).T.copy()
        data.qpos[:3] = self._wanted[0] - rotation_sole_torso @ data.xpos[foot]
        mujoco.mju_mat2Quat(data.qpos[3:7], rotation_sole_torso.ravel())
        data.qvel[:] = 0.0
        self._flatten_soles()

    def _flatten_soles(self) -> None:
        """Move the legs until both ankles are at their positions, soles flat."""
        data, model, wanted = self._data, self._model, self._wanted
        jacobian = np.zeros((6, model.nv))
        for _ in range(ITERATIONS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for leg, foot in enumerate(self.feet):
                columns = self.v_index[leg * N_LEG : (leg + 1) * N_LEG]
                mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], foot)
                r = _without_yaw(data.xmat[foot].reshape(3, 3), self._yaws[leg])
                turn = 0.5 * np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
                error = np.concatenate((wanted[leg] - data.xpos[foot], -turn))
                step = np.linalg.solve(jacobian[:, columns], error)
                data.qpos[self.q_index[leg * N_LEG : (leg + 1) * N_LEG]] += step
        mujoco.mj_forward(model, data)
        self.ankles = np.array([data.xpos[foot] for foot in self.feet])


def _without_yaw(rotation: Array, yaw: float) -> Array:
    """Return Rz(yaw)^T rotation: the foot's small rotation from flat."""
    if yaw == 0.0:
        return rotation
    c, s = math.cos(yaw), math.sin(yaw)
    return np.asarray(np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation, float)
