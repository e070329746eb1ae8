"""Somebody else's `tools`, `shared` or `services` stands in nobody's way."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from shared.places import CHECKOUT

XRL = "import sys; from xrl_main import main; sys.exit(main())"
STARTS = """
import subprocess, sys, types, xrl_main
child = [sys.executable, "-c", "import tools, shared; print(tools.__file__, shared.__file__)"]
sys.modules["tools"] = types.ModuleType("tools")
sys.modules["tools.cli"] = types.SimpleNamespace(main=lambda: subprocess.call(child))
sys.exit(xrl_main.main())
"""
"""A verb that does nothing but start a process."""


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    for name in ("tools", "shared", "services"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('foreign')\n")
    return tmp_path


def run(code: str, *words: str, path: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-P", "-c", code, *words],
        env={**os.environ, "PYTHONPATH": path}, cwd=folder,
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("words", [["faults"], ["status", "--run-dir", "none"]])
def test_a_verb_runs_beside_packages_of_its_packages_names(words: list[str], foreign: Path) -> None:
    done = run(XRL, *words, path=str(foreign), folder=foreign)
    assert "foreign" not in done.stderr
    assert done.returncode == (0 if words[0] == "faults" else 2), done.stderr


def test_processes_that_a_verb_starts_find_ours_too(foreign: Path) -> None:
    done = run(STARTS, path=str(foreign), folder=foreign)
    ours = [str(CHECKOUT / name / "__init__.py") for name in ("tools", "shared")]
    assert done.stdout.split() == ours, done.stderr
