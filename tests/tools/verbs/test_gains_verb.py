"""`xrl gains`, as a user meets it."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

from shared.config import files as config_file
from shared.config import gain_schedule
from tests.conftest import ROBOT_FILE
from tests.tools.exit_codes import exit_code
from tools.lab.design import split_program

TEXT = ROBOT_FILE.read_text(encoding="utf-8")
GRID = {"N_HEIGHTS": 5, "DYNAMIC_HEIGHTS": 2, "DYNAMIC_PITCHES": (0.0,)}
"""Grid of the schedule made here; tests/tools/lab/design makes one as it is shipped."""


def robot_file(tmp_path: Path, key: str = "", value: str = "") -> Path:
    """Write the shipped robot with one line changed, with no schedule beside it."""
    path = tmp_path / "lab.toml"
    text, count = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", TEXT) if key else (TEXT, 1)
    assert count == 1
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def unladen(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a robot file with no payload, its schedule made, and what was said."""
    path = robot_file(tmp_path_factory.mktemp("unladen"), "payload", "0.0")
    beside = ROBOT_FILE.with_name("robot.gains.json")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as said:
        for name, value in GRID.items():
            patch.setattr(split_program, name, value)
        assert exit_code(["gains", "--config", path, "--damping-of", beside]) == 0
    return path, said.getvalue()


def test_a_schedule_for_no_payload_is_written_beside_the_robot_file(
    unladen: tuple[Path, str],
) -> None:
    path, said = unladen
    assert {found.name for found in path.parent.iterdir()} == {"lab.toml", "lab.gains.json"}
    assert f"written to {path.with_name('lab.gains.json')}" in said
    robot = config_file.load(path)
    assert robot.mass.payload == 0.0
    gain_schedule.require(robot, path)


def test_margins_above_what_the_planner_asks_for_are_printed(
    unladen: tuple[Path, str],
) -> None:
    path, said = unladen
    certificate = config_file.load(path).certificate
    spoken = " ".join(said.split())
    found = re.search(r"smallest margin[^:]*: ([\d.]+) with.*?, ([\d.]+) with", spoken)
    assert found, said
    assert float(found[1]) > certificate.margin_min
    assert float(found[2]) > certificate.onboard_margin_min


def test_a_lighter_robot_is_held_more_softly(unladen: tuple[Path, str]) -> None:
    light, full = (config_file.load(file).gain_schedule for file in (unladen[0], ROBOT_FILE))
    assert light is not None
    assert full is not None
    ankle_theta = 1
    assert light.D[len(light.z) // 2][1][ankle_theta] < full.D[12][1][ankle_theta]


def test_check_reports_a_fit_until_the_robot_changes(
    unladen: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = unladen
    schedule = path.with_name("lab.gains.json")
    assert exit_code(["gains", "--check", "--config", robot_file(tmp_path)]) == 3
    assert "the gain schedule is missing" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == [tmp_path / "lab.toml"], "and writes none"
    before = schedule.read_bytes()
    assert exit_code(["gains", "--check", "--config", path]) == 0
    assert capsys.readouterr() == (f"{schedule}: fits the robot\n", "")
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("payload = 0.0 ", "payload = 3.0 "), encoding="utf-8")
    try:
        assert exit_code(["gains", "--check", "--config", path]) == 3
    finally:
        path.write_text(text, encoding="utf-8")
    said = capsys.readouterr()
    assert said.err == ""
    assert "was made for mass.payload = 0.0, not 3.0" in said.out
    assert schedule.read_bytes() == before


@pytest.mark.parametrize("beside", [None, "{}"], ids=["no schedule", "a corrupt one"])
def test_what_no_gains_can_hold_is_one_line_and_leaves_what_was_there(
    beside: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also beside a corrupt schedule, which is to be made again: it gets as far as the program."""
    path = robot_file(tmp_path, "K_required", "[1e5, 1e5, 1e5, 1e5, 1e5, 1e5]")
    schedule = path.with_name("lab.gains.json")
    if beside is not None:
        schedule.write_text(beside, encoding="utf-8")
    assert exit_code(["gains", "--config", path]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("xrl: ")
    assert "lower certificate.K_required" in line
    assert schedule.exists() is (beside is not None)
    assert len(list(tmp_path.iterdir())) == 1 + (beside is not None)
