"""The command line skeleton, as a user meets it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tools.verb_table import VERBS

MINE = ("up", "status", "kill", "tare", "down")


def xrl(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "tools.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def assert_one_line_error(done: subprocess.CompletedProcess[str], code: int = 2) -> None:
    assert done.returncode == code, done.stderr
    assert done.stderr.startswith("xrl: ")
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stdout == ""


def test_help_lists_every_verb() -> None:
    done = xrl("--help")
    assert done.returncode == 0
    for verb in VERBS:
        assert verb.name in done.stdout
        assert verb.help.split()[0] in done.stdout


def test_help_imports_no_verb() -> None:
    code = (
        "import sys, contextlib, tools.cli\n"
        "with contextlib.suppress(SystemExit): tools.cli.main(['--help'])\n"
        "heavy = {'zenoh', 'numpy', 'rich', 'supervisor', 'mujoco', 'pinocchio', 'matplotlib'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60)


@pytest.mark.parametrize("verb", MINE)
def test_each_verb_has_help_with_examples(verb: str) -> None:
    done = xrl(verb, "--help")
    assert done.returncode == 0, done.stderr
    assert f"examples:\n  xrl {verb}" in done.stdout


def test_an_unknown_verb_is_refused() -> None:
    done = xrl("levitate")
    assert done.returncode == 2
    assert "levitate" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_misspelt_verb_is_told_what_it_is_like() -> None:
    done = xrl("staus")
    assert done.returncode == 2
    assert "did you mean status" in done.stderr


def test_no_fleet_is_one_line(tmp_path: Path) -> None:
    for verb in (("status",), ("kill", "planner"), ("tare",)):
        assert_one_line_error(xrl(*verb, "--run-dir", str(tmp_path)))


def test_down_without_a_fleet_succeeds_and_makes_nothing(tmp_path: Path) -> None:
    done = xrl("down", "--run-dir", str(tmp_path / "none"))
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "none").exists()


def test_a_missing_robot_file_is_one_line_and_starts_nothing(tmp_path: Path) -> None:
    run_dir = tmp_path / "run"
    assert_one_line_error(xrl("up", "--config", "nowhere.toml", "--run-dir", str(run_dir)))
    assert not run_dir.exists()


def test_an_unknown_scenario_is_one_line_that_lists_the_known(tmp_path: Path) -> None:
    done = xrl("up", "--scenario", "moonwalk", "--run-dir", str(tmp_path))
    assert_one_line_error(done)
    assert "moonwalk" in done.stderr
    assert "squat" in done.stderr
