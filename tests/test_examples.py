"""Each script in examples/ runs as a user would run it, and does what it says."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.tools.exit_codes import exit_code

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"


def run(*words: str | Path, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run Python; the exit code is as expected."""
    done = subprocess.run(
        [sys.executable, *words], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done


def lines_of(name: str, *arguments: str) -> list[str]:
    """Return the lines that a script prints."""
    return run(EXAMPLES / name, *arguments).stdout.splitlines()


def test_every_example_is_listed_and_tested() -> None:
    scripts = {path.name for path in EXAMPLES.glob("*.py")}
    listed = {name for name in scripts if f"`{name}`" in (EXAMPLES / "README.md").read_text()}
    here = Path(__file__)
    tests = here.read_text() + (here.parent / "system/test_led_live.py").read_text()
    assert listed == scripts == {name for name in scripts if f'"{name}"' in tests}


def test_the_drive_of_its_own_holds_its_target_under_load() -> None:
    assert lines_of("own_drive.py")[0].startswith("ARMED: theta -0.99")


def test_one_module_holds_and_gives_back_what_the_load_takes() -> None:
    lines = lines_of("hold_one_module.py")
    assert all("HOLD" in line for line in lines)
    assert "torque  -20.0" in lines[2]
    assert "theta  -1.0000" in lines[-1]


def test_the_robot_in_virtual_time_holds_while_the_planner_is_dead_and_is_led_again() -> None:
    lines = lines_of("virtual_planner.py")
    assert lines[-1] == "stood"
    assert "HHHHHH" in lines[2]
    assert lines[-2].endswith("TTTTTT")


def test_the_lqr_leads_in_the_planners_place_and_the_robot_stands_when_it_is_killed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And its run is read into NumPy."""
    words = ["sim", "--controller", EXAMPLES / "lqr_controller.py", "--scenario", "squat"]
    words += ["--duration", "3", "--kill", "planner@1.5", "--out", tmp_path / "run"]
    assert exit_code(words) == 0
    assert "STOOD" in capsys.readouterr().out
    lines = lines_of("read_a_run.py", str(tmp_path / "run" / "run.mcap"))
    assert lines[0].startswith("3.0 s, COM x ")
    assert "states, age 4." in lines[1]


def test_the_gymnasium_environment_passes_its_checker_and_the_shipped_law_stands() -> None:
    pytest.importorskip("gymnasium")
    assert lines_of("gym_environment.py")[0].endswith("stood")


def test_a_gentler_hand_leads_the_same_squat_with_less_force() -> None:
    shipped, gentle = (line.split() for line in lines_of("own_operator.py"))
    force, height = 2, 8
    assert float(gentle[force]) <= 12.0 < float(shipped[force])
    assert float(gentle[height]) == pytest.approx(float(shipped[height]), abs=0.005)
