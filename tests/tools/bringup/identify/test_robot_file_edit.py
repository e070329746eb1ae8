"""Measured values in the robot file: comments stay, a backup is made, nothing is half done."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.config import files as config_file
from shared.exceptions import ConfigError, RunError
from tests.conftest import ROBOT_FILE
from tools.bringup.identify.estimates import Value
from tools.bringup.identify.robot_file_edit import apply, edited

VALUES: dict[str, Value] = {
    "mass.payload": 18.4,
    "mass.payload_com": (0.02, -0.01, 0.0),
    "drive.torque_constant": 0.078,
    "joint.tau_module_max": 109.1,
}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(ROBOT_FILE.read_text(encoding="utf-8"), encoding="utf-8")
    return path


def test_only_what_was_measured_changes_and_comments_stay(file: Path) -> None:
    before = file.read_text(encoding="utf-8")
    backup = apply(file, VALUES, {"drive.torque_constant", "mass.payload"}, "now")
    after = file.read_text(encoding="utf-8")
    assert backup.read_text(encoding="utf-8") == before
    robot = config_file.load_without_schedule(file)
    assert robot.mass.payload == 18.4
    assert robot.mass.payload_com == (0.02, -0.01, 0.0)
    assert robot.drive.torque_constant == 0.078
    assert "drive.torque_constant" not in robot.assumed
    assert "geometry.harness_point" in robot.assumed
    lost = set(before.splitlines()) - set(after.splitlines())
    assert len(lost) == 5, lost  # four values and one assumption
    assert "# m_pl, variable, at the torso's centre" in after


def test_a_value_that_no_robot_can_have_changes_nothing(file: Path) -> None:
    before = file.read_text(encoding="utf-8")
    with pytest.raises(ConfigError, match="payload"):
        apply(file, {"mass.payload": 90.0}, set(), "now")
    assert file.read_text(encoding="utf-8") == before
    assert [path.name for path in file.parent.iterdir()] == ["lab.toml"]


def test_a_backup_is_never_overwritten(file: Path) -> None:
    apply(file, VALUES, set(), "now")
    written = file.read_text(encoding="utf-8")
    with pytest.raises(RunError, match="not changed"):
        apply(file, {"mass.payload": 15.0}, set(), "now")
    assert file.read_text(encoding="utf-8") == written


def test_what_is_no_toml_is_refused() -> None:
    with pytest.raises(RunError, match="not a TOML"):
        edited("mass = [", "lab.toml", VALUES, set())
