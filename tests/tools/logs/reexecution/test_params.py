"""`--param`: one key of the recorded robot file with another value."""

from __future__ import annotations

import pytest

from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError
from tools.logs.reexecution.params import with_params


@pytest.mark.parametrize("text", ["law.K_p.x=2000", "law.K_p.0=2000", "law.K_p.x = 2e3"])
def test_a_gain_has_one_value_by_each_of_its_names(robot: RobotConfig, text: str) -> None:
    changed = with_params(robot, [text], "run.mcap")
    assert changed.law.K_p == (2000.0, *robot.law.K_p[1:])
    assert changed.law.B_p == robot.law.B_p


def test_several_are_set_and_everything_else_stays(robot: RobotConfig) -> None:
    changed = with_params(robot, ["joint_service.blend_ms=100", "law.lead_easing=0.1"], "f")
    assert changed.joint_service.blend_ms == 100.0
    assert changed.law.lead_easing == 0.1
    assert changed.mass == robot.mass
    assert changed.module == robot.module


def test_the_schedule_that_was_recorded_is_used_with_the_changed_gains(robot: RobotConfig) -> None:
    changed = with_params(robot, ["law.K_p.x=2000"], "f")
    assert gain_schedule.why_stale(changed) == ""
    assert changed.gain_schedule is not None
    assert robot.gain_schedule is not None
    assert changed.gain_schedule.D == robot.gain_schedule.D


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("law.K_p.x", "NAME=VALUE"),
        ("law.K_q.x=1", "law.K_q.x=1: no such key"),
        ("law.K_p.north=1", "x to yaw"),
        ("law.K_p.9=1", "index"),
        ("law.K_p.x=soft", "no value"),
        ("law.K_p.x.y=1", "no such key"),
        ("law=1", "law: 1 is not valid"),
        ("law.K_p.x=-5", "law.K_p"),
        ("joint_service.loop=magic", "loop"),
    ],
)
def test_a_value_that_cannot_be_set_is_refused_with_what_would_be_right(
    robot: RobotConfig, text: str, says: str
) -> None:
    with pytest.raises(ConfigError) as error:
        with_params(robot, [text], "run.mcap")
    assert says in str(error.value)
