"""The robot file of a robot that is not emulated, and a place for sockets."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig


@pytest.fixture
def real(robot: RobotConfig) -> RobotConfig:
    """Return the shipped robot on real buses."""
    buses = enumerate(robot.can)
    can = {name: CanConfig(interface="socketcan", channel=f"can{i}") for i, name in buses}
    return msgspec.structs.replace(robot, can=can)


@pytest.fixture
def short_path() -> Iterator[Path]:
    """Return a folder whose name leaves a socket's path room."""
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as folder:
        yield Path(folder)
