"""Which drives a verb means."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from tools.bringup import drive_access


def test_a_robot_file_with_one_bus_forgotten_never_finds_emulated_drives_right(
    robot: RobotConfig, real: RobotConfig, tmp_path: Path
) -> None:
    """Its USB would be the emulated one, and every setting there is as wanted."""
    half = msgspec.structs.replace(real, can=real.can | {"harness": robot.can["harness"]})
    drives = drive_access.drives_within_reach(half, tmp_path / "robot.toml", tmp_path / "r")
    with pytest.raises(FleetError, match=r"\[can\.harness\] is emulated"), drives:
        pass
    assert not (tmp_path / "r").exists()
