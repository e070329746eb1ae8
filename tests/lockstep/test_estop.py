"""The emergency stop in virtual time: a slow sink, never a drop."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from shared.config import RobotConfig
from shared.messages import Mode
from tests.lockstep.runs import still
from tools.runs.lockstep import Lockstep


@pytest.mark.parametrize("height", [1.188, 0.9])
@pytest.mark.parametrize("hand", [True, False])
def test_the_robot_sinks_slowly_and_does_not_topple(
    robot: RobotConfig, height: float, hand: bool
) -> None:
    fleet = Lockstep(robot, still(12.0, height))
    heights = []
    for truth in fleet.run():
        if truth.scenario_s >= 4.0 and not fleet.estop:
            fleet.estop = True
            if not hand:
                fleet.world.let_go()
        if fleet.estop:
            heights.append(truth.torso[2])
            assert not truth.fallen, f"{truth.scenario_s:.2f} s"
    assert all(controller.failsafe.mode is Mode.DAMP for controller in fleet.controllers)
    speed = -np.gradient(heights, 0.01)
    assert speed.max() < 0.25, "slowly"
    if not hand:  # a hand that holds on holds it up
        assert heights[-1] < heights[0] - 0.05, "it sinks"


def test_a_stop_without_a_planner_sinks_as_well(robot: RobotConfig) -> None:
    story = msgspec.structs.replace(still(10.0), hand=False)
    fleet = Lockstep(robot, story)
    fleet.planner = None
    heights = []
    for step in range(10_000):
        fleet.advance()
        fleet.estop = step > 3000
        if step % 10 == 0:
            truth = fleet.world.truth(0, 1.0, 0.0)
            heights.append(truth.torso[2])
            assert not truth.fallen, f"{step} ms"
    assert (-np.gradient(heights[300:], 0.01)).max() < 0.25
