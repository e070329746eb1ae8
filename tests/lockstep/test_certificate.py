"""The certificate against the simulation, at the few cases where it is hardest to be right."""

from __future__ import annotations

import numpy as np
import pytest

from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from tests.planner import oracle
from tools.lab.studies.sweeps import certificate_trial as study
from tools.lab.studies.sweeps import figures
from tools.lab.studies.sweeps.certificate_trial import CertificateCase, CertificateCases

SEED = 1

DRAWN = 300

CLEAR = 0.1
"""Fraction of K_required; nearer to zero the floor's own elasticity may decide."""

TRIED = 5
"""The nearest on either side."""


@pytest.fixture(scope="module")
def drawn(robot: RobotConfig) -> list[CertificateCase]:
    cases = CertificateCases(robot)
    return sorted((cases.draw(SEED, number) for number in range(DRAWN)), key=margin_of)


def margin_of(case: CertificateCase) -> float:
    return case.weakest.margin


def nearest(drawn: list[CertificateCase], side: float) -> list[CertificateCase]:
    """Return the cases on one side of zero that are nearest to it, and clear of it."""
    clear = [case for case in drawn if side * margin_of(case) > CLEAR]
    assert len(clear) >= TRIED
    return sorted(clear, key=lambda case: side * margin_of(case))[:TRIED]


def test_the_cases_are_about_half_of_either_kind(drawn: list[CertificateCase]) -> None:
    positive = sum(margin_of(case) > 0.0 for case in drawn)
    assert 0.4 * DRAWN < positive < 0.6 * DRAWN


def test_a_case_starts_at_rest(robot: RobotConfig, drawn: list[CertificateCase]) -> None:
    """p by the oracle's own kinematics, and by where the simulated robot is."""
    for case in (drawn[0], drawn[DRAWN // 2], drawn[-1]):
        loaded = figures.with_payload(robot, case.posture.payload)
        world = study.world_of(robot, case, rigid=False)
        truth = world.truth(0, 1.0, 0.0)
        p = np.array([*truth.com, *truth.angles])
        np.testing.assert_allclose(p, oracle.pose(loaded, case.posture.q), atol=1e-5)
        np.testing.assert_allclose(p[[0, 1, 3, 4, 5]], [0, 0, 0, case.posture.pitch, 0], atol=1e-5)
        assert max(truth.foot_right_tilt, truth.foot_left_tilt) < 1e-5
        assert np.abs(world.data.qvel).max() == 0.0
        assert truth.hoist == 0.0


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["lets stand", "refuses"])
def test_what_the_certificate_lets_stand_stands_and_what_it_refuses_falls(
    robot: RobotConfig, drawn: list[CertificateCase], side: float
) -> None:
    stood = {case.number: study.run_case(case, robot).stood for case in nearest(drawn, side)}
    assert set(stood.values()) == {side > 0.0}, stood


def test_on_a_rigid_floor_it_is_sharper(robot: RobotConfig, drawn: list[CertificateCase]) -> None:
    near = [case for case in drawn if 0.005 < abs(margin_of(case)) < 0.03]
    assert {margin_of(case) > 0.0 for case in near} == {True, False}
    outcomes = [(case, study.run_case(case, robot, rigid=True)) for case in near]
    wrong = [case.number for case, o in outcomes if o.stood is not (margin_of(case) > 0.0)]
    assert wrong == []


def test_a_slow_drift_away_is_no_stand(robot: RobotConfig, drawn: list[CertificateCase]) -> None:
    case = drawn[-1]
    world = study.world_of(robot, case, rigid=False)
    still = world.truth(0, 1.0, 0.0)

    def course(*com_x: float) -> list[SimTruth]:
        rows = []
        for x in com_x:
            world.data.subtree_com[0][0] = x
            rows.append(world.truth(0, 1.0, 0.0))
        return rows

    assert not still.fallen
    assert study.judge(course(0.0, 0.02, 0.03, 0.02, 0.01, 0.01)).stood
    assert not study.judge(course(0.0, 0.01, 0.02, 0.03, 0.04, 0.05)).stood
    assert not study.judge(course(0.0, 0.1, 0.2, 0.1, 0.0, 0.0)).stood


def test_the_same_number_is_the_same_case(robot: RobotConfig, drawn: list[CertificateCase]) -> None:
    case = drawn[7]
    again = CertificateCases(robot).draw(SEED, case.number)
    np.testing.assert_array_equal(again.D, case.D)
    np.testing.assert_array_equal(again.posture.q, case.posture.q)
    assert again.nudge == case.nudge
