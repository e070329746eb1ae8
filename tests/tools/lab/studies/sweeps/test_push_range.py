"""The pushes of the studies: up to the physical limit, the one the push study draws."""

from __future__ import annotations

import math
import random

import pytest

from shared.config.robot_config import RobotConfig
from tests.tools.exit_codes import exit_code
from tools.lab.studies.sweeps.push_range import PushRange
from tools.lab.studies.sweeps.push_trial import PushTrial, limits_of


@pytest.fixture(scope="module")
def pushes(robot: RobotConfig) -> PushRange:
    return PushRange(robot, 1.0)


@pytest.mark.parametrize("angle_deg", [0, 45, 90, 180, -90])
def test_the_limit_is_that_of_the_push_study_in_the_stand(
    robot: RobotConfig, pushes: PushRange, angle_deg: int
) -> None:
    point = PushTrial(number=0, pose="stand", angle_deg=angle_deg, duration_s=3.0, mode="led")
    borne = limits_of(point, robot).body.force_n
    assert pushes.limit_n(math.radians(angle_deg)) == pytest.approx(borne, rel=0.02)


def test_a_push_is_its_share_of_the_limit_in_its_direction(pushes: PushRange) -> None:
    push = pushes.push(1.0, 0.3, 0.5, math.pi / 2)
    assert push.force == pytest.approx((0.0, 0.5 * pushes.limit_n(math.pi / 2), 0.0), abs=1e-3)
    assert (push.at, push.duration) == (1.0, 0.3)


def test_what_is_drawn_reaches_the_limit_in_every_direction(pushes: PushRange) -> None:
    dice, reached = random.Random(1), {-2: 0.0, -1: 0.0, 0: 0.0, 1: 0.0}
    for _ in range(300):
        x, y, _ = pushes.draw(dice, (0.3, 1.0), 1.0, 0.3).force
        angle = math.atan2(y, x)
        share = math.hypot(x, y) / pushes.limit_n(angle)
        assert 0.299 <= share <= 1.001
        quarter = math.floor(2.0 * angle / math.pi)
        reached[quarter] = max(reached[quarter], share)
    assert min(reached.values()) > 0.95


@pytest.mark.parametrize("study", ["kill", "robust"])
@pytest.mark.parametrize("share", ["0", "-1", "4", "nan"])
def test_a_share_that_is_none_is_refused(
    study: str, share: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["study", "sweep", study, "--n", "1", "--push", share]) == 2
    assert "--push" in capsys.readouterr().err
