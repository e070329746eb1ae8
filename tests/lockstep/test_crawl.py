"""The crawl under assist, in virtual time."""

from __future__ import annotations

import numpy as np
import pytest

from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from tests.lockstep.runs import Run, kill, run, variant


@pytest.fixture(scope="module")
def crawl(robot: RobotConfig) -> Run:
    return run(robot, variant("crawl"))


def test_the_robot_goes_down_to_crawling_and_back(crawl: Run) -> None:
    assert crawl.stood
    assert min(row.torso[2] for row in crawl.rows) < 0.82
    assert crawl.angles[:, 1].max() > 1.15
    assert crawl.rows[-1].torso[2] > 1.15


def test_balance_is_kept_under_full_assist(crawl: Run) -> None:
    assert np.abs(crawl.com_mm[:, 0]).max() <= 10.0
    assert np.abs(crawl.com_mm[:, 1]).max() <= 5.0


def test_the_assist_carries_the_operators_weight(crawl: Run) -> None:
    holding = [row for row in crawl.rows if 7.0 < row.scenario_s < 9.9]
    rested = 0.9 * 200.0  # of what he asked for: the realistic plant's person
    assert all(row.load_n == pytest.approx(rested, abs=0.1) for row in holding)
    given = np.mean([row.harness_force_z for row in holding])
    assert given == pytest.approx(200.0, abs=10.0)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("at", [3.5, 8.0])
def test_the_robot_stands_if_the_planner_dies_in_the_crawl(robot: RobotConfig, at: float) -> None:
    outcome = run(robot, variant("crawl", duration=at + 3.0, kill=kill(at)))
    assert outcome.stood
    assert all(c.failsafe.mode is Mode.HOLD for c in outcome.lockstep.controllers)


def test_the_ankles_hold_against_an_operator_who_pulls_himself_up(robot: RobotConfig) -> None:
    """With the gains frozen as they were, the soles tipped at 13 s of this run."""
    outcome = run(robot, variant("crawl", duration=15.5, kill=kill(8.0)))
    assert outcome.stood
    hold = outcome.t >= 8.0
    assert np.abs(outcome.operator_n[hold]).max() == pytest.approx(150.0), "he must pull"
    assert np.abs(outcome.com_mm[hold, 0]).max() <= 40.0
