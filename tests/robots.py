"""The shipped robot; it is frozen, so every test may share it."""

from __future__ import annotations

from typing import Final

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.places import DEFAULT_CONFIG

ROBOT: Final[RobotConfig] = config_file.load(DEFAULT_CONFIG)
