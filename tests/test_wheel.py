"""What a wheel holds, and that it runs where there is no checkout."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from shared import revision
from shared.places import CHECKOUT

PACKAGES = ("services", "shared", "tools")
LEFT_OUT = ("tools/dev/mutants.py", "tools/dev/reference/")
"""They work on the source tree."""
NO_DATA = ("deploy/ros2/",)
"""Files that documentation names, and no process reads."""
VERSION = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"][
    "version"
]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=CHECKOUT, check=True, capture_output=True, timeout=60)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("installed") / "site"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--disable-pip-version-check", "--target", str(target), str(wheel)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return target


def xrl(installed: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the installed command in a folder; the packages that it needs are this environment's."""
    return subprocess.run(
        [str(installed / "bin" / "xrl"), *words], cwd=folder, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(installed)}, timeout=110, check=False,
    )  # fmt: skip


def sources(*folders: str) -> list[Path]:
    """Return the files of some folders that a person wrote."""
    found = [path for name in folders for path in (CHECKOUT / name).rglob("*") if path.is_file()]
    return [path for path in found if "__pycache__" not in path.parts]


def test_the_wheel_holds_packages_data_and_commit(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        for path in sources(*PACKAGES):
            name = path.relative_to(CHECKOUT).as_posix()
            held = name in archive.namelist()
            assert held != name.startswith(LEFT_OUT), name
            assert not held or archive.read(name) == path.read_bytes()
    data = [path for path in sources("deploy") if path.suffix in (".toml", ".json", ".rules")]
    with zipfile.ZipFile(wheel) as archive:
        for path in data:
            if not path.relative_to(CHECKOUT).as_posix().startswith(NO_DATA):
                name = f"shared/files/{path.relative_to(CHECKOUT / 'deploy').as_posix()}"
                assert archive.read(name) == path.read_bytes()
    assert len(data) > 10
    with zipfile.ZipFile(wheel) as archive:
        assert json.loads(archive.read(revision.BUILT_FROM)) == revision.code(CHECKOUT)


def test_the_version_stands_in_one_file_only() -> None:
    texts = [*CHECKOUT.glob("*.*"), *sources("deploy", "docs", *PACKAGES)]
    named = re.compile(rf"(?<![\d.]){re.escape(VERSION)}(?![\d.])".encode())
    skipped = (".lock", ".png", ".gif")
    found = [
        path.name for path in texts
        if path.is_file() and path.suffix not in skipped and named.search(path.read_bytes())
    ]  # fmt: skip
    assert set(found) - {"CHANGELOG.md"} == {"pyproject.toml"}


@pytest.mark.system
def test_an_installed_wheel_tells_its_version_and_commit(installed: Path, tmp_path: Path) -> None:
    said = xrl(installed, tmp_path, "--version").stdout
    assert said == f"xrl {VERSION} ({revision.in_words(revision.code(CHECKOUT))})\n"


@pytest.mark.system
def test_an_installed_wheel_runs_a_robot_of_its_own_directory(
    installed: Path, tmp_path: Path
) -> None:
    lab = tmp_path / "lab"
    assert xrl(installed, tmp_path, "new", "lab").returncode == 0
    done = xrl(installed, lab, "sim", "--duration", "1", "--out", "run")
    assert done.returncode == 0, done.stderr
    assert "config: ./robot.toml" in done.stderr
    assert "STOOD for 1.0 s" in done.stdout
    assert (lab / "run" / "run.mcap").is_file()
