"""The failsafe's times and limits."""

from __future__ import annotations

import pytest

from services.joint.failsafe import Timing, timing_of
from shared.config.robot_config import RobotConfig


@pytest.fixture(scope="session")
def timing(robot: RobotConfig) -> Timing:
    """Return those of the shipped robot."""
    return timing_of(robot)
