"""`xrl log export --gif`: the robot of a run, drawn where it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.joints import SIDES
from shared.robot.robot_model import ankle_positions
from tests.tools.judge.reports.runs import Made
from tools import cli
from tools.judge.reports.moving_picture import FRAMES_S, MODE_INK, SIZE, world_frames
from tools.judge.reports.robot_pose import poses
from tools.logs.run_log import RunLog


@pytest.fixture(scope="module")
def drawn(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("gif") / "run.gif"
    assert cli.main(["log", "export", str(made.path), "--gif", str(out)]) == 0
    return out


def test_the_drawn_ankles_stand_where_the_robots_do(log: RunLog, robot: RobotConfig) -> None:
    """Through the legs' chains from the torso: joints' flexibility and play stay below 10 mm."""
    *_, last = poses(log, robot, FRAMES_S)
    frames = world_frames(robot, last)
    for side, wanted in zip(SIDES, ankle_positions(robot), strict=True):
        np.testing.assert_allclose(frames[f"ankle_{side}"][0], wanted, atol=0.01)


def test_the_picture_is_as_long_as_the_scenario(drawn: Path) -> None:
    with Image.open(drawn) as picture:
        assert picture.size == SIZE
        assert picture.n_frames / FRAMES_S == pytest.approx(4.0, abs=0.2)


def test_modules_change_their_colour_from_track_to_hold_when_the_planner_dies(drawn: Path) -> None:
    seen = []
    with Image.open(drawn) as picture:
        for seconds in (0.8, 1.5):
            picture.seek(round(seconds * FRAMES_S))
            pixels = np.asarray(picture.convert("RGB"))[120:, :300]  # the robot from the side
            seen.append({"#{:02x}{:02x}{:02x}".format(*pixel) for pixel in pixels.reshape(-1, 3)})
    assert [MODE_INK[Mode.TRACK] in inks for inks in seen] == [True, False]
    assert [MODE_INK[Mode.HOLD] in inks for inks in seen] == [False, True]
