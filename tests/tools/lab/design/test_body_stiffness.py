"""Body stiffness against the paper's printed numbers (section IV)."""

from __future__ import annotations

import math

import pytest

from shared.config.robot_config import RobotConfig
from tools.lab.design.body_stiffness import body_stiffness, for_robot

ROUNDING = 1e-3
"""The paper rounds theta_edge to 0.0490 and g to 9.8 on the way."""


def test_the_papers_numbers_come_out(robot: RobotConfig) -> None:
    design = for_robot(robot)["y"]
    assert design.theta_edge == pytest.approx(0.0490, rel=ROUNDING)
    assert math.degrees(design.theta_edge) == pytest.approx(2.81, abs=0.005)
    assert design.tau_edge == pytest.approx(17.76, rel=1.5 * ROUNDING)
    assert design.K_ank_min == pytest.approx(362.65, rel=ROUNDING)
    assert design.K_min == pytest.approx(432.0, rel=1.5 * ROUNDING)
    assert design.K_tau_max == pytest.approx(2810.0, rel=ROUNDING)


def test_ankles_too_strong_to_be_overpowered_have_no_largest_lean() -> None:
    assert math.isnan(body_stiffness(mass=10.0, height=0.5, half_sole=0.1, tau_max=100.0).theta_max)
