"""The reference: one step of the inverse kinematics from where it was going, inside the limits."""

from __future__ import annotations

import numpy as np
import pytest

from services.planner.law.inverse_kinematics import TOLERANCE, InverseKinematics
from services.planner.law.kinematics import Kinematics
from services.planner.law.reference import Reference
from shared.arrays import Array
from tests.planner.states import DT, ROBOT, Law, closed

NOWHERE = np.tile([-4.0, 4.0], (12, 1))
"""Joint limits that stop nothing."""


def solved(reference: Reference, q: Array, p_ref: Array) -> int:
    """Solve for p_ref from q, at rest; return the iterations."""
    at_start = Kinematics(ROBOT)
    at_start.update(q)
    reference.load(np.zeros(6), np.zeros(6), np.zeros(3), np.zeros(3), at_start.D_left)
    return reference.solve(q, p_ref).iterations


@pytest.mark.parametrize("away", [1e-5, 2e-4, 0.02, 0.05])
def test_it_finds_what_the_solver_does(away: float) -> None:
    q = closed(1.0, pitch=0.3)
    there = Kinematics(ROBOT)
    there.update(q)
    p_ref = there.p + away * np.array([0.1, -0.1, 1.0, 0.0, 0.5, 0.0])
    reference = Reference(ROBOT)
    iterations = solved(reference, q, p_ref)
    there.update(reference.q)
    assert np.abs(there.p - p_ref).max() < 2.0 * TOLERANCE
    assert np.abs(there.closure).max() < 2.0 * TOLERANCE
    assert (iterations == 1) == (away < 1e-4)


@pytest.mark.parametrize("rate", [0.005, 0.05, 0.2, 0.6])
def test_led_beyond_it_stays_inside(rate: float) -> None:
    """The solver takes a start for granted; one beyond the limits let q_ref creep to 0.17 rad."""
    limits = np.array(ROBOT.joint_limits())
    law, ik = Law(), InverseKinematics(Kinematics(ROBOT), NOWHERE)
    height = 0.923  # of the COM: 4 mm below where the knees come to their limit
    ik.q[:] = closed(1.15)
    p = np.array([0.0, 0.0, height, 0.0, 0.0, 0.0])
    assert ik.solve(p, iterations_max=50).converged
    q = ik.q.copy()
    law.align(q)
    beyond = 0.0
    while p[2] < height + 0.01:
        p[2] += rate * DT
        ik.solve(p, iterations_max=50)
        v, q = (ik.q - q) / DT, ik.q.copy()
        q_ref = law.tick(q, v, 0.0, DT).q_ref
        beyond = max(beyond, float(np.maximum(limits[:, 0] - q_ref, q_ref - limits[:, 1]).max()))
    assert np.maximum(limits[:, 0] - q, q - limits[:, 1]).max() > 0.03, "it was led beyond"
    assert beyond < 1e-9


@pytest.mark.parametrize("rate", [-50.0, 50.0])
def test_the_next_begins_inside(rate: float) -> None:
    reference = Reference(ROBOT)
    solved(reference, closed(1.0), np.zeros(6))
    reference.v[:] = rate
    low, high = np.array(ROBOT.joint_limits()).T
    np.testing.assert_array_equal(reference.expected(1.0), low if rate < 0.0 else high)


def test_its_kinematics_are_those_of_its_own_arrays() -> None:
    """With the load sharing that the tick chose, not one of its own."""
    reference, q = Reference(ROBOT), closed(1.0, pitch=0.3)
    D_left = np.diag([0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
    reference.load(np.zeros(6), np.zeros(6), np.zeros(3), np.zeros(3), D_left)
    reference.evaluate(q)
    kinematics = reference.kinematics()
    np.testing.assert_array_equal(kinematics.J, reference.J)
    np.testing.assert_array_equal(kinematics.p, reference.p)
    np.testing.assert_array_equal(kinematics.J_harness, reference.J_harness)


def test_of_nan_nothing_is_found_but_the_next_is() -> None:
    q = closed(1.0)
    there = Kinematics(ROBOT)
    there.update(q)
    reference = Reference(ROBOT)
    p_ref = there.p.copy()
    p_ref[1] = np.nan
    reference.load(np.full(6, np.nan), np.zeros(6), np.zeros(3), np.zeros(3), there.D_left)
    assert not reference.solve(q, p_ref).converged
    start = reference.expected(DT)
    assert np.isfinite(start).all()
    reference.load(np.zeros(6), np.zeros(6), np.zeros(3), np.zeros(3), there.D_left)
    assert reference.solve(start, there.p).converged
    np.testing.assert_allclose(reference.q, q, atol=1e-6)
