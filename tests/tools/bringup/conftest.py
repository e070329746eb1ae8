"""The robot file of a robot that is not emulated."""

from __future__ import annotations

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig


@pytest.fixture
def real(robot: RobotConfig) -> RobotConfig:
    """Return the shipped robot on real buses."""
    can = {
        name: CanConfig(interface="socketcan", channel=f"can{i}")
        for i, name in enumerate(robot.can)
    }
    return msgspec.structs.replace(robot, can=can)
