"""An emergency stop in the middle of a motion takes over what the legs carry."""

from __future__ import annotations

import itertools

import pytest

from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from tests.lockstep.runs import variant
from tools.sim.lockstep import Lockstep


@pytest.mark.parametrize(("name", "at"), [("squat", 0.6), ("squat", 1.5), ("crawl", 1.0)])
def test_no_joint_is_jerked(robot: RobotConfig, name: str, at: float) -> None:
    """With damping, rates and coupling changed in one cycle, one had a blow of 18 to 33 N m."""
    fleet = Lockstep(robot, variant(name, duration=at + 0.5, kill=(), push=()))
    taus: list[list[float]] = []
    for _ in range(10_000):
        fleet.estop = fleet.world.scenario_s >= at
        fleet.advance()
        if fleet.estop:
            taus.append([tau for each in fleet.controllers for tau in each.tau])
        if fleet.world.scenario_s >= at + 0.3:
            break
    stops = [event for _, event in fleet.events if event.mode_after == Mode.DAMP]
    assert [event.mode_before for event in stops] == [Mode.TRACK] * 6
    for event in stops:
        assert event.tau_after == pytest.approx(event.tau_before, abs=5.0)
    for before, after in itertools.pairwise(taus):
        assert after == pytest.approx(before, abs=5.0), "nor a moment later"
