"""Optional packages: which extra brings each, and how it is told that one is absent."""

import importlib.metadata
import re
import sys
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest

from shared.exceptions import MissingPackageError
from shared.extras import (
    EXTRAS,
    ON_ROBOTS,
    UNLOCKED,
    is_installed,
    late,
    require,
)  # fmt: skip

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OPTIONAL: dict[str, list[str]] = PROJECT["optional-dependencies"]
NO_USE = {"build", "dev", "docs", "desk"}
"""Extras of no verb: the last one is several others in one word."""


def distribution(requirement: str) -> str:
    return re.split(r"[^\w.-]", requirement)[0].lower()


def packages_of(extra: str) -> set[str]:
    """Return the distributions of an extra, and of those that it names."""
    found = set()
    for requirement in OPTIONAL[extra]:
        inner = re.fullmatch(r"xrl\[(.*)\]", requirement)
        if inner is None:
            found.add(distribution(requirement))
        else:
            found |= set().union(*(packages_of(name) for name in inner[1].split(",")))
    return found


@cache
def distributions() -> Mapping[str, list[str]]:
    return importlib.metadata.packages_distributions()


def locked_lines(name: str) -> list[str]:
    text = (ROOT / name).read_text(encoding="utf-8")
    return [line for line in text.splitlines() if re.match(r"[a-z].*==", line)]


def locked(name: str) -> set[str]:
    return {line.partition("==")[0] for line in locked_lines(name)}


def test_the_table_has_the_extras_of_the_project() -> None:
    assert set(EXTRAS) == set(OPTIONAL) - NO_USE


@pytest.mark.parametrize("extra", EXTRAS)
def test_an_extra_brings_the_packages_that_the_table_says(extra: str) -> None:
    for name in EXTRAS[extra]:
        brings = {one.lower() for one in distributions().get(name, [])}
        assert brings & packages_of(extra) or (not brings and extra in UNLOCKED), name


def test_locks_hold_what_their_extras_say_and_the_page_counts_them() -> None:
    held = locked("requirements.runtime.lock")
    assert {distribution(requirement) for requirement in PROJECT["dependencies"]} <= held
    assert held & set().union(*(packages_of(extra) for extra in EXTRAS)) == set()
    page = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
    assert f"{len(locked('requirements.runtime.lock'))} packages, 0.8 GB" in page
    for extra in ON_ROBOTS:
        lines = locked_lines(f"requirements.{extra}.lock")
        count = sum("; sys_platform == 'win32'" not in line for line in lines)
        row = next(line for line in page.splitlines() if line.startswith(f"| `{extra}` |"))
        assert f"| {count} |" in row
    held = locked("requirements.lock")
    for extra in set(EXTRAS) - UNLOCKED:
        assert packages_of(extra) <= held, extra


@pytest.mark.parametrize("extra", sorted(ON_ROBOTS))
def test_a_lock_of_some_robots_holds_what_it_adds_to_a_robots_lock(extra: str) -> None:
    held = locked(f"requirements.{extra}.lock")
    assert packages_of(extra) <= held
    assert held & locked("requirements.runtime.lock") == set()
    assert held <= locked("requirements.lock")


def test_what_is_absent_is_told_with_its_extra_and_what_brings_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    require("sim")
    assert is_installed("sim")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert not is_installed("sim")
    with pytest.raises(MissingPackageError) as found:
        require("sim")
    install = ROOT / "deploy" / "install"
    assert str(found.value) == f"mujoco is not installed; the extra `sim` includes it: {install}"
    monkeypatch.setitem(sys.modules, "odrive", None)
    with pytest.raises(MissingPackageError, match=r"deploy/install --runtime usb$"):
        require("usb")
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(
        MissingPackageError, match=r"^mujoco and PIL are not .* includes them: .*; or"
    ):
        require("sim", "look at a record")


def test_a_late_module_is_imported_when_it_is_used_and_says_if_it_is_absent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    mujoco = late("mujoco")
    assert "mujoco" not in sys.modules
    assert mujoco.mj_step is sys.modules["mujoco"].mj_step
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    cvxpy = late("cvxpy")
    with pytest.raises(MissingPackageError, match=r"^cvxpy is not installed; the extra `design`"):
        _ = cvxpy.Variable


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("raise ImportError('its core is missing.\\n  pip install core')",
         "its core is missing. pip install core"),
        ("import there_is_no_such_package", "No module named 'there_is_no_such_package'"),
        ("import rosbags._inner", "No module named 'rosbags._inner'"),
        ("import ctypes; ctypes.CDLL('no_such_library.so')", "no_such_library.so: .*"),
        ("1 / 0", "division by zero"),
    ],
)  # fmt: skip
def test_a_package_that_cannot_be_imported_says_why_in_one_line_and_its_extra(
    code: str, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "rosbags").mkdir()
    (tmp_path / "rosbags" / "__init__.py").write_text(code, encoding="utf-8")
    for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    brings = f"the extra `ros2` includes it: {ROOT}/deploy/install --runtime ros2$"
    pattern = f"^rosbags is installed but cannot be imported: {said}; {brings}"
    with pytest.raises(MissingPackageError, match=pattern):
        require("ros2")
    with pytest.raises(MissingPackageError, match=pattern):
        _ = late("rosbags.typesys").name
