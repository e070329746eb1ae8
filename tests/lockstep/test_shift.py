"""The robot leans and turns as it is asked to, and stands there when the planner dies."""

from __future__ import annotations

import numpy as np
import pytest

from shared.bus.messages import Vector4
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe
from tests.lockstep.runs import kill, push, restart, run, variant
from tools.lab.studies.sweeps import plants


@pytest.mark.parametrize("signs", [(1, 1, 1, 1), (-1, 1, -1, 1)])
def test_it_comes_to_the_farthest_corner_and_stands_pushed_there_without_a_planner(
    robot: RobotConfig, signs: tuple[int, ...]
) -> None:
    x, y, roll, yaw = (sign * most for sign, most in zip(signs, robot.law.shift_max, strict=True))
    asked: Vector4 = (x, y, 2.0 * roll, yaw)  # beyond the limit: the limit
    outcome = run(
        robot,
        variant(
            "stand",
            duration=6.5,
            keyframe=(
                Keyframe(at=0.0, height=1.188),
                Keyframe(at=2.0, height=1.0, shift=asked),
            ),
            kill=kill(3.8),
            push=(push(4.2, 30.0, 0.0, 0.0), push(5.2, 0.0, 30.0, 0.0)),
        ),
    )
    there = int(np.searchsorted(outcome.t, 3.7))
    np.testing.assert_allclose(outcome.com_mm[there, :2], [1e3 * x, 1e3 * y], atol=6.0)
    assert outcome.angles[there, 0] == pytest.approx(roll, abs=0.01)
    assert outcome.angles[there, 2] == pytest.approx(yaw, abs=0.01)
    assert np.abs(outcome.operator_n[outcome.t < 3.7]).max() < 30.0, "the hand leads on"
    assert outcome.stood
    assert max(max(row.foot_left_tilt, row.foot_right_tilt) for row in outcome.rows) < 0.05


def test_a_planner_that_comes_back_to_a_leaning_robot_leads_it_to_the_same_lean(
    robot: RobotConfig,
) -> None:
    asked: Vector4 = (0.02, 0.03, 0.0, 0.08)
    frames = (Keyframe(at=0.0, height=1.188), Keyframe(at=1.5, height=1.1, shift=asked))
    there_and_back = variant(
        "stand", duration=8.0, keyframe=frames, kill=kill(3.0), restart=restart(3.4), push=()
    )
    outcome = run(robot, there_and_back)
    assert outcome.stood
    np.testing.assert_allclose(outcome.com_mm[-1, :2], [20.0, 30.0], atol=6.0)
    assert outcome.angles[-1, 2] == pytest.approx(0.08, abs=0.01)
    moved = np.abs(np.diff(outcome.com_mm[:, :2], axis=0)).max()
    assert moved < 2.0, "it goes there, it does not jump"


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("drawn", "signs"), [("shift-15", (-1, -1, 1, -1)), ("shift-21", (-1, 1, -1, 1))]
)
def test_it_stands_at_the_corner_on_plants_with_every_error_drawn(
    robot: RobotConfig, drawn: str, signs: tuple[int, ...]
) -> None:
    """The two of 36 that went farthest: 69 and 73 mm."""
    x, y, roll, yaw = (sign * most for sign, most in zip(signs, robot.law.shift_max, strict=True))
    frames = (
        Keyframe(at=0.0, height=1.188),
        Keyframe(at=2.0, height=1.188, shift=(x, y, roll, yaw)),
    )
    pushes = (push(4.2, 30.0, 0.0, 0.0), push(5.2, -30.0, 0.0, 0.0))
    leaned = variant("stand", duration=6.5, keyframe=frames, kill=kill(3.8), push=pushes)
    outcome = run(robot, leaned, plant=plants.draw(drawn))
    assert outcome.stood
    assert np.hypot(*outcome.com_mm[-1, :2]) > 20.0, "it leans to the end"
