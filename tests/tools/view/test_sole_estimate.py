"""What the legs' torques say of the soles, against the simulated floor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from services.planner.law.kinematics import Kinematics
from services.planner.law.model import leg_geometry
from shared.bus.traces import SimTruth
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.robot.robot_model import stand_pose
from tests.lockstep.runs import still
from tools.sim.lockstep import Lockstep, begin_standing
from tools.view.frame import SoleEstimate, jacobian


class AtRest(NamedTuple):
    """A robot that stands still."""

    weight: float
    truth: SimTruth
    q: list[float]
    tau: list[float]


@pytest.fixture(scope="module", params=[1.15, 0.95])
def at_rest(robot: RobotConfig, request: pytest.FixtureRequest) -> AtRest:
    fleet = Lockstep(robot, still(4.0, request.param))
    begin_standing(fleet)
    truth = list(fleet.run())[-1]
    return AtRest(
        float(fleet.world.model.body_mass.sum()) * GRAVITY,
        truth,
        [angle for controller in fleet.controllers for angle in controller.samples.q],
        [torque for controller in fleet.controllers for torque in controller.tau],
    )


def test_at_rest_it_is_within_4_percent_and_5_millimetres(
    robot: RobotConfig, at_rest: AtRest
) -> None:
    truth = at_rest.truth
    estimated = SoleEstimate(robot).of(at_rest.q, at_rest.tau)
    assert estimated is not None
    true = (
        (truth.foot_right_force, truth.foot_right_cop),
        (truth.foot_left_force, truth.foot_left_cop),
    )
    for found, (force, cop) in zip(estimated, true, strict=True):
        assert found.force[2] == pytest.approx(force[2], rel=0.04)
        assert found.cop == pytest.approx(cop, abs=0.005)


def test_the_two_soles_bear_the_whole_robot_and_who_holds_it(at_rest: AtRest) -> None:
    truth = at_rest.truth
    borne = truth.foot_right_force[2] + truth.foot_left_force[2]
    held = truth.load_n - truth.operator_force[2]
    assert borne == pytest.approx(at_rest.weight + held, rel=0.01)
    middle = 0.5 * (np.array(truth.foot_right_cop) + truth.foot_left_cop)
    assert middle == pytest.approx(truth.com[:2], abs=0.01), "standing still"


def test_the_legs_jacobian_is_that_of_the_law(robot: RobotConfig) -> None:
    """Compared with the torso's position in `Kinematics`, with all of the load on one leg."""
    q = np.array(stand_pose(robot, 1.05)) + np.random.default_rng(3).uniform(-0.1, 0.1, 12)
    known = Kinematics(robot)
    for index, leg in enumerate(leg_geometry(robot)):
        known.update(q, np.eye(6) * index)
        own = slice(6 * index, 6 * index + 6)
        J, r_torso = jacobian(leg, q[own])
        assert r_torso == pytest.approx(known.r_torso, abs=1e-9)
        step = 1e-6
        for joint in range(6):
            moved = q.copy()
            moved[own.start + joint] += step
            _, r_moved = jacobian(leg, moved[own])
            assert (r_moved - r_torso) / step == pytest.approx(J[:3, joint], abs=1e-5)


def test_straight_legs_say_nothing(robot: RobotConfig) -> None:
    assert SoleEstimate(robot).of([0.0] * 12, [1.0] * 12) is None
