"""One generated model: Pinocchio, MuJoCo and the paper's equations tell the same robot."""

from __future__ import annotations

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from services.planner.law.model import load_pinocchio, q_tree
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.joints import JOINTS, SIDES
from shared.robot.robot_model import mjcf
from tests.planner import oracle
from tests.planner.states import ROBOT


def random_q(count: int) -> Array:
    return np.random.default_rng(7).uniform(-1.2, 1.2, (count, 12))


class Simulated:
    """The model in MuJoCo, the torso at the origin, level."""

    def __init__(self, robot: RobotConfig) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf(robot))
        self.data = mujoco.MjData(self.model)
        self.index = [self.model.joint(name).qposadr[0] for name in JOINTS]

    def update(self, q: Array) -> None:
        self.data.qpos[:] = 0.0
        self.data.qpos[3] = 1.0
        self.data.qpos[self.index] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def seen_from_foot(self, side: str, place: Array) -> Array:
        """Return a place in the axes of a foot, from its ankle."""
        foot = self.data.body(f"foot_{side}")
        return np.asarray(foot.xmat.reshape(3, 3).T @ (place - foot.xpos), float)


class Rigid:
    """The model in Pinocchio, the torso at the origin, level."""

    def __init__(self, robot: RobotConfig) -> None:
        self.model = load_pinocchio(robot)
        self.data = self.model.createData()

    def update(self, q: Array) -> None:
        full = q_tree(q, self.model)
        pin.forwardKinematics(self.model, self.data, full)
        pin.centerOfMass(self.model, self.data, full)

    def joint(self, kind: str, side: str) -> pin.SE3:
        """Return where the body below a module is; its two joints are one in Pinocchio."""
        name = f"{kind}_{side}"
        return self.data.oMi[next(i for i, n in enumerate(self.model.names) if name in n)]


def test_total_mass_is_the_papers_in_both() -> None:
    simulated, rigid = Simulated(ROBOT), Rigid(ROBOT)
    assert oracle.masses(ROBOT)[1] == pytest.approx(74.58)
    assert simulated.model.body_mass.sum() == pytest.approx(74.58)
    assert pin.computeTotalMass(rigid.model) == pytest.approx(74.58)
    assert simulated.model.body("torso").mass[0] == pytest.approx(39.66)


def test_pinocchio_and_mujoco_agree_on_com_feet_and_knees() -> None:
    simulated, rigid = Simulated(ROBOT), Rigid(ROBOT)
    for q in random_q(100):
        simulated.update(q)
        rigid.update(q)
        np.testing.assert_allclose(rigid.data.com[0], simulated.data.subtree_com[0], atol=1e-12)
        for side in SIDES:
            for kind, body in (("ankle", f"foot_{side}"), ("knee", f"shin_{side}")):
                there, here = simulated.data.body(body), rigid.joint(kind, side)
                np.testing.assert_allclose(here.translation, there.xpos, atol=1e-12)
                np.testing.assert_allclose(here.rotation.ravel(), there.xmat, atol=1e-12)


def test_it_is_the_papers_equations_seen_from_each_foot() -> None:
    """The centre of mass too, its four modules below the torso where each leg has them."""
    simulated = Simulated(ROBOT)
    data = simulated.data
    _, m_total = oracle.masses(ROBOT)
    for q in random_q(100):
        simulated.update(q)
        weighed = np.zeros(3)  # of the modules below the torso, from its centre, in its axes
        for index, side in enumerate(SIDES):
            want = oracle.leg(ROBOT, index, q)
            harness = want.torso + want.R @ np.array(ROBOT.geometry.harness_point)
            for place, expected in (
                (data.body("torso").xpos, want.torso),
                (data.body(f"shin_{side}").xpos, want.knee),
                (data.site("harness").xpos, harness),
            ):
                got = simulated.seen_from_foot(side, place)
                np.testing.assert_allclose(got, expected - want.ankle, atol=1e-12)
            foot = data.body(f"foot_{side}").xmat.reshape(3, 3)
            np.testing.assert_allclose(foot.T, want.R, atol=1e-12)
            weighed += want.R.T @ (want.knee + want.ankle - 2.0 * want.torso)
        from_torso = data.subtree_com[0] - data.body("torso").xpos
        com = ROBOT.mass.module * weighed / m_total
        np.testing.assert_allclose(from_torso, com, atol=1e-12)
