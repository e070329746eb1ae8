"""Kinematics, and a planner, which most tests share."""

from __future__ import annotations

import numpy as np
import pytest

from services.planner.law.kinematics import Kinematics
from services.planner.planner import Planner
from shared.arrays import Array
from tests.planner.states import ROBOT, SESSION, closed, shipped_ik, with_law
from tools.reach import ReachSolver


@pytest.fixture(scope="session")
def kinematics() -> Kinematics:
    """Return kinematics that every test updates before it reads them."""
    return Kinematics(ROBOT)


@pytest.fixture(scope="session")
def averaging() -> Kinematics:
    """Return kinematics that mix the legs by a plain average."""
    return Kinematics(with_law(ROBOT, jacobian="average"))


@pytest.fixture
def ik() -> ReachSolver:
    return shipped_ik()


@pytest.fixture
def planner() -> Planner:
    return Planner(ROBOT, SESSION)


@pytest.fixture
def q() -> Array:
    """Return a stand that is a little off centre and pitched."""
    return np.array(closed(1.188, x=0.01, pitch=0.1))
