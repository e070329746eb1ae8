"""`xrl gains`, as a user meets it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from shared.config import files as config_file
from shared.config import gain_schedule
from tests.conftest import ROBOT_FILE

TEXT = ROBOT_FILE.read_text(encoding="utf-8")


def gains(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tools.cli", "gains", *arguments],
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )


def robot_file(tmp_path: Path, key: str = "", value: str = "") -> Path:
    """Write the shipped robot with one line changed, with no schedule beside it."""
    path = tmp_path / "lab.toml"
    text, count = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", TEXT) if key else (TEXT, 1)
    assert count == 1
    path.write_text(text, encoding="utf-8")
    return path


def assert_one_line_error(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("xrl: ")
    assert done.stderr.count("\n") == 1, done.stderr
    assert "Traceback" not in done.stderr


@pytest.fixture(scope="module")
def unladen(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a robot file with no payload, its schedule made, and what was said."""
    path = robot_file(tmp_path_factory.mktemp("unladen"), "payload", "0.0")
    beside = str(ROBOT_FILE.with_name("robot.gains.json"))
    done = gains("--config", str(path), "--damping-of", beside)
    assert done.returncode == 0, done.stderr
    return path, done.stdout


def test_a_schedule_for_no_payload_is_written_beside_the_robot_file(
    unladen: tuple[Path, str],
) -> None:
    path, said = unladen
    assert {found.name for found in path.parent.iterdir()} == {"lab.toml", "lab.gains.json"}
    assert f"written to {path.with_name('lab.gains.json')}" in said
    robot = config_file.load(path)
    assert robot.mass.payload == 0.0
    gain_schedule.require(robot, path)


def test_the_printed_margins_are_above_what_the_planner_asks_for(
    unladen: tuple[Path, str],
) -> None:
    path, said = unladen
    certificate = config_file.load(path).certificate
    spoken = " ".join(said.split())
    found = re.search(
        r"smallest margin[^:]*: ([\d.]+) of what is required.*?, ([\d.]+) with", spoken
    )
    assert found, said
    assert float(found[1]) > certificate.margin_min
    assert float(found[2]) > certificate.onboard_margin_min


def test_the_hardest_push_of_each_tier_is_printed(unladen: tuple[Path, str]) -> None:
    _, said = unladen
    assert re.search(r"slope without an IMU.*\d\.\d degrees forwards", said)
    rows = re.findall(r"^ *\d\.\d{3} +(.*)", said.split("Hardest constant push")[1], re.M)
    assert rows
    for row in rows:
        assert re.search(r"\d+ / \d+", row), row


def test_a_lighter_robot_is_held_more_softly(unladen: tuple[Path, str]) -> None:
    light, full = (
        config_file.load(unladen[0]).gain_schedule,
        config_file.load(ROBOT_FILE).gain_schedule,
    )
    assert light is not None
    assert full is not None
    ankle_theta = 1
    assert light.D[12][1][ankle_theta] < full.D[12][1][ankle_theta]


def test_check_reports_a_fit_until_the_robot_changes(unladen: tuple[Path, str]) -> None:
    path, _ = unladen
    before = path.with_name("lab.gains.json").read_bytes()
    fits = gains("--check", "--config", str(path))
    assert (fits.returncode, fits.stderr) == (0, "")
    assert fits.stdout == f"{path.with_name('lab.gains.json')}: fits the robot\n"
    heavier = path.read_text(encoding="utf-8").replace("payload = 0.0 ", "payload = 3.0 ")
    path.write_text(heavier, encoding="utf-8")
    try:
        stale = gains("--check", "--config", str(path))
    finally:
        path.write_text(heavier.replace("payload = 3.0 ", "payload = 0.0 "), encoding="utf-8")
    assert (stale.returncode, stale.stderr) == (3, "")
    assert "was made for mass.payload = 0.0, not 3.0" in stale.stdout
    assert path.with_name("lab.gains.json").read_bytes() == before


def test_check_without_a_schedule_is_exit_code_3_and_writes_none(tmp_path: Path) -> None:
    path = robot_file(tmp_path)
    done = gains("--check", "--config", str(path))
    assert (done.returncode, done.stderr) == (3, "")
    assert "there is no gain schedule" in done.stdout
    assert list(tmp_path.iterdir()) == [path]


def test_what_no_gains_can_hold_is_one_line_and_leaves_no_file(tmp_path: Path) -> None:
    path = robot_file(tmp_path, "K_required", "[1e5, 1e5, 1e5, 1e5, 1e5, 1e5]")
    done = gains("--config", str(path))
    assert_one_line_error(done)
    assert "lower certificate.K_required" in done.stderr
    assert list(tmp_path.iterdir()) == [path]


def test_a_corrupt_schedule_can_be_made_again(tmp_path: Path) -> None:
    """The message about it says so: make it again. Here it gets as far as the program."""
    path = robot_file(tmp_path, "K_required", "[1e5, 1e5, 1e5, 1e5, 1e5, 1e5]")
    path.with_name("lab.gains.json").write_text("{}", encoding="utf-8")
    done = gains("--config", str(path))
    assert_one_line_error(done)
    assert "lower certificate.K_required" in done.stderr


def test_a_missing_robot_file_is_one_line() -> None:
    assert_one_line_error(gains("--config", "nowhere.toml"))
