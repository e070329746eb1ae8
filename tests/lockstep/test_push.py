"""Lasting pushes with the planner dead; `xrl sweep push` has every direction, pose and mode."""

from __future__ import annotations

from shared.config import RobotConfig
from shared.scenario import Push
from tests.lockstep.runs import kill, run, still


def test_hold_bears_a_hundred_newtons_from_the_side_for_three_seconds(robot: RobotConfig) -> None:
    """With the hips' theta as soft as led it fell at 70 N, with the knees' at 30 N."""
    pushed = (Push(at=0.6, duration=3.0, force=(0.0, 100.0, 0.0)),)
    outcome = run(robot, still(5.0, kill=kill(0.2), push=pushed))
    assert outcome.stood
    assert abs(outcome.com_mm[outcome.t > 1.0, 1]).max() > 30.0, "the push is felt"
    assert outcome.rows[-1].torso[2] > 1.1, "it came back up"
