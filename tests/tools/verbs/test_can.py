"""`xrl drive can`: the commands for real buses, and the emulated drives as they answer."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.config import files
from shared.config.robot_config import RobotConfig
from tests.tools.exit_codes import exit_code
from tools.bringup import check_host
from tools.verbs.drive import can


@pytest.fixture
def real_file(real: RobotConfig, tmp_path: Path) -> Path:
    path = tmp_path / "robot.toml"
    path.write_text(files.to_toml(real), encoding="utf-8")
    return path


def test_setup_prints_what_brings_each_used_interface_up_and_runs_nothing(
    real_file: Path, robot: RobotConfig, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(can, "_ran", None)
    assert exit_code(["drive", "can", "setup", "--config", real_file]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 * len(robot.buses) + 1
    assert lines[1] == "ip link set can0 up type can bitrate 1000000 restart-ms 100"
    assert check_host.up_command("can0") == f"`sudo {lines[1]}`", "as the doctor says"


def test_setup_ends_at_the_first_command_that_fails(
    real_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """There is no can0 here, or no right to it."""
    assert exit_code(["drive", "can", "setup", "--config", real_file, "--apply"]) in (2, 3)
    told = capsys.readouterr()
    assert told.out.splitlines()[0] == "ip link set can0 down"
    assert len(told.out.splitlines()) == 1
    assert told.err


def test_an_emulated_robot_has_nothing_to_set_up(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_code(["drive", "can", "setup"]) == 0
    assert "nothing to bring up" in capsys.readouterr().out


def test_a_bus_that_is_not_there_is_one_line(
    real_file: Path, run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = ["--run-dir", run_dir, "--config", real_file]
    assert exit_code(["drive", "can", "test", *place]) in (2, 3)
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    assert "can0" in told.out + told.err


@pytest.mark.system
def test_every_emulated_axis_is_heard_and_answers(
    run_dir: Path, robot: RobotConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert exit_code(["drive", "can", "test", "--run-dir", run_dir]) == 0
    shown = capsys.readouterr().out
    for module in robot.module:
        assert f"{module.name}.axis0" in shown
        assert f"{module.name}.axis1" in shown
    assert "load cells: " in shown
    assert "silent" not in shown
