"""The kinematics, and closed configurations made by the inverse kinematics."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from services.planner.law.inverse_kinematics import InverseKinematics
from services.planner.law.kinematics import Kinematics
from services.planner.planner import Planner
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.robot.robot_model import stand_pose
from tests.planner import oracle
from tests.planner.states import SESSION, with_law
from tools.reach import ReachSolver

Closed = Callable[..., Array]
"""closed(height, x=, y=, roll=, pitch=, yaw=) -> q (12,) where the legs agree."""

SQUAT = (1.25, 1.188, 1.1, 1.0, 0.948, 0.85)
"""Torso heights over which the robot squats, m."""


@pytest.fixture(scope="session")
def kinematics(robot: RobotConfig) -> Kinematics:
    """Return kinematics that every test updates before it reads them."""
    return Kinematics(robot)


@pytest.fixture(scope="session")
def averaging(robot: RobotConfig) -> Kinematics:
    """Return kinematics that mix the legs by a plain average."""
    return Kinematics(with_law(robot, jacobian="average"))


@pytest.fixture(scope="session")
def limits(robot: RobotConfig) -> Array:
    return np.array(robot.joint_limits())


@pytest.fixture(scope="session")
def ik(robot: RobotConfig, limits: Array) -> ReachSolver:
    return ReachSolver(Kinematics(robot), limits)


def com_height(robot: RobotConfig, height: float) -> float:
    """Return the COM's height of a level stand with its torso at a height, m."""
    return float(oracle.pose(robot, np.array(stand_pose(robot, height)))[2])


def p_at(robot: RobotConfig, height: float, **parts: float) -> Array:
    """Return p (6,) for a torso height of a level stand, and the other parts as named."""
    x, y, roll, pitch, yaw = (parts.get(n, 0.0) for n in ("x", "y", "roll", "pitch", "yaw"))
    return np.array([x, y, com_height(robot, height), roll, pitch, yaw])


def at_pose(robot: RobotConfig, ik: InverseKinematics, p: Array, start: Array) -> Array:
    """Return q (12,) at p, polished until the oracle agrees to 1e-13; asserts it got there."""
    ik.q[:] = start
    for _ in range(3):  # each solve stops at its tolerance; the next goes on from there
        ik.solve(p, iterations_max=60)
    return oracle.closed_chain(robot, ik.q.copy())(p)


@pytest.fixture(scope="session")
def closed(robot: RobotConfig, ik: ReachSolver) -> Closed:
    @cache
    def made(height: float, parts: frozenset[tuple[str, float]]) -> Array:
        start = np.array(stand_pose(robot, 1.188))
        return at_pose(robot, ik, p_at(robot, height, **dict(parts)), start)

    def make(height: float, **parts: float) -> Array:
        return made(height, frozenset(parts.items())).copy()

    return make


@pytest.fixture
def planner(robot: RobotConfig) -> Planner:
    return Planner(robot, SESSION)


@pytest.fixture
def q(closed: Closed) -> Array:
    """Return a stand that is a little off centre and pitched."""
    return closed(1.188, x=0.01, pitch=0.1)
