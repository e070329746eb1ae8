"""Without an optional package a verb says in one line what is absent, before it begins anything."""

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from shared.config.files import load_without_schedule
from shared.extras import EXTRAS
from shared.places import CHECKOUT, DEFAULT_CONFIG
from tools import cli
from tools.verbs import doctor


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        ("demo", "sim"),
        ("demo --view", "sim"),
        ("sim", "sim"),
        ("study kill --n 1", "sim"),
        ("study crash --quick", "sim"),
        ("log whatif OUT --kill planner", "sim"),
        ("bench", "sim"),
        ("bench fleet", "sim"),
        ("gains", "design"),
        ("view", "view"),
        ("view --sim", "sim"),
        ("up --run-dir run --out o", "sim"),
        ("up --run-dir run --out o --no-sim --ros2", "ros2"),
        ("log export OUT --gif a.gif", "plot"),
        ("log export OUT --ros2bag bag", "ros2"),
        ("ros2 check", "ros2"),
    ],
)
def test_a_verb_names_the_extra_that_it_lacks(
    words: str,
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in {name for names in EXTRAS.values() for name in names}:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.chdir(tmp_path)
    assert cli.main(shlex.split(words.replace("OUT", str(tmp_path / "run.mcap")))) == 2
    output, errors = capsys.readouterr()
    assert errors.count("\n") == 1
    assert f"the extra `{extra}` includes " in errors
    assert output == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("verb", ["sim", "doctor"])
def test_a_verb_whose_package_cannot_be_imported_gives_the_packages_remedy_in_one_line(
    verb: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As MuJoCo 3 upgraded in place to 4: pip leaves the new package without its core."""
    (tmp_path / "mujoco").mkdir()
    code = "raise ImportError('mujoco-core is missing.\\n  pip install --force-reinstall mujoco')"
    (tmp_path / "mujoco" / "__init__.py").write_text(code, encoding="utf-8")
    path = os.pathsep.join((str(tmp_path), str(CHECKOUT)))
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.chdir(tmp_path)
    command = [sys.executable, "-m", "tools.cli", verb]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(
        "xrl: mujoco is installed but cannot be imported: mujoco-core is missing. "
        "pip install --force-reinstall mujoco; the extra `sim` includes it: "
    )
    assert done.stderr.count("\n") == 1
    assert [file.name for file in tmp_path.iterdir()] == ["mujoco"]


def test_doctor_tells_in_a_row_that_no_settings_are_read_without_the_package_for_usb(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "lab.toml"
    text = DEFAULT_CONFIG.read_text(encoding="utf-8")
    file.write_text(text.replace('interface = "xrl_unix"', 'interface = "socketcan"'), "utf-8")
    robot = load_without_schedule(file)
    monkeypatch.setitem(sys.modules, "odrive", None)
    (row,) = doctor._Usb(robot, {}, services_up=False).rows(tmp_path)
    assert row.found == "odrive is not installed"
    assert row.fix.startswith("the extra `usb` includes it: ")
