from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

from shared import config_file
from shared.config import RobotConfig

# A busy machine is no failed claim: no time limit for one example.
settings.register_profile("no_deadline", deadline=None)
settings.load_profile("no_deadline")

ROBOT_FILE = Path(__file__).parents[1] / "deploy" / "robot.toml"


@pytest.fixture(scope="session")
def robot() -> RobotConfig:
    """Return the shipped robot; it is frozen, so every test may share it."""
    return config_file.load(ROBOT_FILE)
