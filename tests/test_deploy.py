"""What the deploy scripts choose and say, with stand-ins for a system's programs."""

from __future__ import annotations

import os
import subprocess
import tomllib
from pathlib import Path

import pytest

from shared.extras import ON_ROBOTS

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ("bash", "cat", "dirname", "sha256sum", "find", "mkdir")


def run(system: Path, script: str) -> subprocess.CompletedProcess[str]:
    """Run a piece of shell with deploy/lib.sh, on a system that has these programs only."""
    words = ["bash", "-c", f"set -euo pipefail; source {ROOT}/deploy/lib.sh; {script}"]
    environment = {"PATH": str(system), "HOME": str(system)}
    return subprocess.run(
        words, env=environment, capture_output=True, text=True, check=False, timeout=30
    )


@pytest.fixture
def system(tmp_path: Path) -> Path:
    for name in TOOLS:
        found = next(p for p in os.defpath.split(":") if (Path(p) / name).exists())
        (tmp_path / name).symlink_to(Path(found) / name)
    return tmp_path


def program(system: Path, name: str, text: str) -> None:
    path = system / name
    path.write_text(f"#!{system}/bash\n{text}\n", encoding="utf-8")
    path.chmod(0o755)


def tried(system: Path) -> list[str]:
    return run(system, 'printf %s "$tried"').stdout.split()


def test_the_package_names_the_pythons_and_extras_of_its_locks(system: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [c.rpartition(" ")[2] for c in project["classifiers"] if "Python :: 3." in c]
    assert sorted(named) == sorted(tried(system))
    assert project["requires-python"] == ">=3.11"
    assert set(run(system, 'printf %s "$robot_extras"').stdout.split()) == ON_ROBOTS
    words = [ROOT / "deploy" / "install", "--runtime", "usb", "sim"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == 2
    assert done.stderr == "deploy: sim: must be one of: ros2 usb\n"


@pytest.mark.parametrize(
    ("there", "taken"),
    [
        ({"python3": "3.11 900"}, "python3"),
        ({"python3": "3.13 900", "python3.11": "3.11 500"}, "python3"),
        ({"python3": "3.10 900", "python3.12": "3.12 900"}, "python3.12"),
        ({"python3.13": "no module named venv", "python3.12": "3.12 900"}, "python3.12"),
        ({"python3.12": "3.12 900", "python3": "3.12 700"}, "python3"),
        ({"python3.12": "3.12 900", "python3": "3.12 890"}, "python3.12"),
        ({"python3": "3.99 900"}, None),
        ({}, None),
    ],
)
def test_the_newest_python_that_was_tried_is_taken_and_of_its_builds_one_clearly_faster(
    system: Path, there: dict[str, str], taken: str | None
) -> None:
    for name, version in there.items():
        program(system, name, f"echo {version}")
    done = run(system, "find_python")
    assert done.stdout.strip() == ("" if taken is None else str(system / taken))
    assert (done.returncode == 0) == (taken is not None)


def test_without_a_python_uv_makes_the_environment(system: Path) -> None:
    program(system, "uv", 'printf "%s " uv "$@"')
    done = run(
        system,
        f"venv={system}/venv half_made={system}/venv/m; fresh_folder() {{ :; }};"
        " check_libraries() { :; }; make_venv",
    )
    assert done.stdout.startswith("uv venv --quiet --seed --allow-existing --python 3.14")
    (system / "uv").unlink()
    done = run(system, "make_venv")
    assert done.returncode == 2
    assert "none of Python 3.14 3.13 3.12 3.11 with its venv module" in done.stderr


def test_an_extra_is_added_by_its_own_lock_with_hashes(system: Path) -> None:
    program(system, "python", 'echo "$*"')
    (system / "bin").mkdir()
    (system / "bin" / "python").symlink_to(system / "python")
    done = run(system, f'venv={system}; add_extras ros2 usb; echo "added $?"')
    first, second, end = done.stdout.splitlines()
    assert first.endswith(f"--requirement {ROOT}/requirements.ros2.lock")
    assert second.endswith(f"--requirement {ROOT}/requirements.usb.lock")
    assert "--require-hashes --only-binary :all: --no-deps" in first
    assert end == "added 0"


@pytest.mark.parametrize(
    ("was", "asked", "made"),
    [
        ("runtime", "any", "runtime"),
        ("full", "any", "full"),
        (None, "any", "full"),
        ("runtime", "full", "full"),
        ("full", "runtime", "runtime"),
    ],
)
def test_an_environment_is_made_again_as_it_was(
    was: str | None, asked: str, made: str, system: Path
) -> None:
    if was is not None:
        (system / "xrl.kind").write_text(f"{was}\n", encoding="utf-8")
    assert run(system, f"kind={system}/xrl.kind; kind_for {asked}").stdout == f"{made}\n"


def test_the_graphs_are_translated_after_a_change_of_files_that_are_there(system: Path) -> None:
    """A file that had moved would be passed over, and its graph be the old one."""
    told = run(system, 'cat() { printf "%s\\n" "$@" >&3; }; graphs_fingerprint 3>&1 >/dev/null')
    stamp, *files = map(Path, told.stdout.split())
    assert stamp.name == "xrl.stamp"
    assert {file.name: file.is_file() for file in files} == {file.name: True for file in files}
    assert "symbolic.py" in {file.name for file in files}
