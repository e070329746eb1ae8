"""`xrl estop`: which robot it stops, and of what it does not say that it has stopped."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from services.joint.neighbours import NeighbourRow, Neighbours
from services.joint.rearm_guard import RearmGuard
from shared.bus.messages import Mode
from shared.bus.topics import VIEWER
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import HUNG_UP_EXIT_CODE
from shared.joints import MODULES
from shared.places import CHECKOUT, DEFAULT_CONFIG
from shared.run_directory import live_dir, make_live_dir
from tests.certified import certified, install_all
from tests.tools.exit_codes import exit_code
from tools.fleet.run_dir import Manifest, RunDir


@pytest.fixture
def fleet(run_dir: Path) -> list[RearmGuard]:
    """Return what the six services of a fleet of the shipped robot have open; all are in DAMP."""
    run_dir.mkdir()
    make_live_dir(run_dir)
    manifest = Manifest(str(DEFAULT_CONFIG), MODULES, {}, (), 1.0)
    RunDir(run_dir).manifest.write_bytes(msgspec.json.encode(manifest))
    for module in MODULES:
        Neighbours(run_dir, module).write(NeighbourRow(1, 0.0, 0.0, Mode.DAMP))
    return [RearmGuard(run_dir, module) for module in MODULES]


def test_another_robots_stop_leaves_the_fleet_of_this_host_alone_and_is_not_taken_for_done(
    run_dir: Path, fleet: list[RearmGuard], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "lab.toml"
    other.write_text(DEFAULT_CONFIG.read_text(encoding="utf-8"), encoding="utf-8")
    assert exit_code(["estop", "--config", other, "--run-dir", run_dir]) == 2
    assert not any(guard.stop_requested for guard in fleet)
    said = capsys.readouterr().err
    assert all(f"{module} silent" in said for module in MODULES)


def test_the_robot_of_this_hosts_fleet_is_stopped_by_shared_memory_too(
    run_dir: Path, fleet: list[RearmGuard]
) -> None:
    assert exit_code(["estop", "--config", DEFAULT_CONFIG, "--run-dir", run_dir]) == 0
    assert all(guard.stop_requested for guard in fleet)


def test_of_several_hosts_one_answers_for_its_own_modules(
    run_dir: Path, fleet: list[RearmGuard], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["estop", "--local", "--run-dir", run_dir, "--partly", "knee_left,hip_left"]
    assert exit_code(words) == 0
    assert "stopped (DAMP): knee_left, hip_left" in capsys.readouterr().out


@pytest.mark.parametrize("partly", [["--partly", "knee_left,hip_left"], []], ids=["partly", "all"])
def test_a_module_without_a_service_here_is_named_and_the_others_are_stopped(
    partly: list[str], run_dir: Path, fleet: list[RearmGuard], capsys: pytest.CaptureFixture[str]
) -> None:
    (live_dir(run_dir) / "knee_left.rearm").unlink()
    assert exit_code(["estop", "--local", "--run-dir", run_dir, *partly]) == 2
    assert "knee_left has no service on this host" in capsys.readouterr().err
    stopped = [guard.stop_requested for guard in fleet]
    assert stopped == [module != "knee_left" for module in MODULES]


def test_a_viewers_key_stands_by_for_nothing(
    robot: RobotConfig, run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secured, made = certified(robot, tmp_path)
    install_all(made, tmp_path / "keys", VIEWER)
    file = tmp_path / "robot.toml"
    file.write_text(config_file.to_toml(secured), encoding="utf-8")
    assert exit_code(["estop", "--wait", "--config", file, "--run-dir", run_dir]) == 2
    assert "this command needs an operator's key" in capsys.readouterr().err


@pytest.mark.parametrize("how", ["a dropped session", "a hang-up"])
def test_one_that_waits_stops_when_its_terminal_goes(
    how: str, run_dir: Path, fleet: list[RearmGuard]
) -> None:
    """A hang-up ended it without a stop."""
    person, terminal = pty.openpty()
    words = [sys.executable, "-m", "tools.cli", "estop", "--wait", "--run-dir", str(run_dir)]
    with subprocess.Popen(
        words, cwd=CHECKOUT, stdin=terminal, stdout=terminal, stderr=terminal
    ) as waiting:
        os.close(terminal)
        told = b""
        while b"q, then Enter, quits" not in told:
            told += os.read(person, 1000)
        if how == "a hang-up":
            waiting.send_signal(signal.SIGHUP)
            assert waiting.wait(timeout=60.0) == 0
            os.close(person)
        else:
            os.close(person)
            assert waiting.wait(timeout=60.0) == HUNG_UP_EXIT_CODE
    assert all(guard.stop_requested for guard in fleet)
