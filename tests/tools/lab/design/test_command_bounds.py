"""What `xrl gains` writes and prints beside the schedule: bounds of commands, body stiffness."""

from __future__ import annotations

import math

import msgspec
import pytest

from services.joint.envelope import Envelope
from services.planner.intents import OperatorRequest
from services.planner.planner import Planner
from shared.bus.messages import Outside
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tests.planner.states import SESSION, START_NS, closed, receive_all
from tools.lab.design.body_stiffness import for_robot

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


def test_ankles_too_strong_to_be_overpowered_have_no_largest_lean(robot: RobotConfig) -> None:
    joint = msgspec.structs.replace(robot.joint, tau_module_max=1e4)
    assert math.isnan(for_robot(msgspec.structs.replace(robot, joint=joint))["y"].theta_max)


@pytest.mark.parametrize("height", [0.8, 0.95, 1.05, 1.188])
@pytest.mark.parametrize("pitch", [-0.3, 0.0, 0.6, 1.2])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_what_the_law_sends_in_a_stand_is_believed(
    robot: RobotConfig, height: float, pitch: float, share: float
) -> None:
    planner, q = Planner(robot, SESSION), closed(height, pitch=pitch)
    planner.receive_request(OperatorRequest(share * robot.assist.force_max))
    receive_all(planner, q, START_NS)
    commands = planner.tick(START_NS)
    assert planner.status(START_NS, 0.0).assist_n == share * robot.assist.force_max
    for module, command in zip(MODULES, commands, strict=True):
        judged = Envelope(robot, module).judge(command, None, command.q_ref, (0.0, 0.0))
        assert judged is Outside.NOTHING, module


def test_both_legs_have_the_same_room_to_either_side(robot: RobotConfig) -> None:
    assert robot.gain_schedule is not None
    assert robot.gain_schedule.bounds is not None
    for bounds in robot.gain_schedule.bounds.values():
        for (low, _), (high, _) in bounds.tau_ff:
            assert low == pytest.approx(-high, abs=2e-3)
