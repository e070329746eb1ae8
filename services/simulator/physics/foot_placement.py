"""Places the simulated robot on its feet: soles flat, ankles in their places."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.physics.body import Body
from shared.extras import late
from shared.joints import JOINTS, N_LEG, SIDES

if TYPE_CHECKING:
    import mujoco
else:
    mujoco = late("mujoco")

Array = NDArray[np.float64]

ITERATIONS: Final = 8
"""Newton steps from `stand_pose` to soles that are flat to rounding."""


class FootPlacement:
    """Solves the legs' joint angles, and knows where the feet stand.

    Attributes:
        q_index: places of the 12 joint angles in MuJoCo's qpos.
        v_index: places of their rates in qvel.
        feet: MuJoCo's ids of the feet, by side.
        ankles: where the feet were placed (2, 3), m; slip is measured from here.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, body: Body) -> None:
        """Take MuJoCo's model and data, and the places of the feet."""
        self._model, self._data = model, data
        joints = [model.joint(name) for name in JOINTS]
        self.q_index = np.array([joint.qposadr[0] for joint in joints])
        self.v_index = np.array([joint.dofadr[0] for joint in joints])
        self.feet = [model.body(f"foot_{side}").id for side in SIDES]
        self._wanted, self._yaws = body.ankles, body.foot_yaws
        self.ankles: Array = np.array(body.ankles)

    def stand_up(self, q: Array, lean: tuple[float, float]) -> None:
        """Place the robot with the torso along the floor and the COM over the ankles by gravity.

        It starts from joint angles q (12,), rad; `lean` is gravity's x and y over its z.
        """
        data, model = self._data, self._model
        data.qpos[self.q_index] = q
        mujoco.mj_kinematics(model, data)
        data.qpos[0] -= data.xpos[self.feet[0]][0]
        self._flatten_soles()
        level = data.subtree_com[0][:2].copy()
        for _ in range(ITERATIONS if any(lean) else 0):
            com = data.subtree_com[0]  # the legs go less far than the torso
            data.qpos[:2] += level + np.array(lean) * com[2] - com[:2]
            self._flatten_soles()

    def stand_at(self, q: Array) -> None:
        """Place the robot, at rest, at joint angles (12,), rad, whose legs agree on the torso."""
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
        """Move the legs until both ankles are in their places, soles flat."""
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
    """Return Rz(yaw)^T rotation: the foot's small rotation against its place."""
    if yaw == 0.0:
        return rotation
    c, s = math.cos(yaw), math.sin(yaw)
    return np.asarray(np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation, float)
