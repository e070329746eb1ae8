"""The file of mutants names what there is, and a mutant is known by what it changes."""

from __future__ import annotations

import argparse
import importlib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from shared.toml_file import read_toml
from tools.dev import mutants
from tools.dev.mutants import (
    FILE,
    ROOT,
    Group,
    MutantsFile,
    Mutation,
    Reason,
    _change_of,
    _GroupResult,
)
from tools.terminal import Console

DIFF = """--- services/joint/differential.py
+++ services/joint/differential.py
@@ -1,5 +1,5 @@
 def _soft_stop(q: float, stops: Pair) -> float:
-    if q < stops[0]:
+    if q <= stops[0]:
         return STIFFNESS * (stops[0] - q)
"""
LIVES = Mutation(
    "services.joint.differential.x__soft_stop", "if q < stops[0]:", "if q <= stops[0]:"
)
WHY = "at the stop itself the spring pulls by nothing"


@pytest.fixture(scope="module")
def told() -> MutantsFile:
    return read_toml(FILE, MutantsFile)


def test_each_module_and_folder_of_tests_is_there_and_in_one_group_only(told: MutantsFile) -> None:
    modules = [module for group in told.group for module in group.modules]
    assert len(modules) == len(set(modules))
    for path in (*modules, *(folder for group in told.group for folder in group.tests)):
        assert (ROOT / path).exists(), path


def test_each_mutant_that_may_live_is_of_a_function_that_is_there(told: MutantsFile) -> None:
    modules = [module for group in told.group for module in group.modules]
    lives = [change for reason in told.reason for change in reason.lives]
    assert len(lives) == len(set(lives))
    for change in lives:
        module, _, mangled = change.function.rpartition(".")
        assert f"{module.replace('.', '/')}.py" in modules
        place: Any = importlib.import_module(module)
        for name in mangled.removeprefix("x").strip("ǁ").split("ǁ"):
            plain = name if "ǁ" in mangled else name.removeprefix("_")
            place = getattr(place, plain)
        assert callable(place), change.function


def test_a_mutant_is_known_by_its_function_and_its_lines() -> None:
    assert _change_of("services.joint.differential.x__soft_stop__mutmut_1", DIFF) == LIVES


def judged(alive: int, listed: tuple[Mutation, ...], **asked: object) -> tuple[int, str]:
    """Return exit code and words for 100 mutants of which some live, each by the same change."""
    found = _GroupResult(Counter(killed=100 - alive, survived=alive), [("one", LIVES)] * alive)
    told = MutantsFile(
        group=(Group(name="a", modules=(), tests=()),),
        reason=(Reason(why=WHY, lives=listed),) if listed else (),
    )
    flags = {"sample": False, "group": None}
    console = Console(record=True, width=200)
    code = mutants._judge([found], told, argparse.Namespace(**(flags | asked)), console)
    return code, console.export_text()


def test_a_mutant_lives_only_for_a_reason_and_at_most_one_in_twenty_do() -> None:
    code, text = judged(1, ())
    assert code == 3
    assert "if q <= stops[0]:" in text
    assert "99 of 100 mutants fail a test (99.0%)" in text
    assert judged(5, (LIVES,))[0] == 0
    code, text = judged(6, (LIVES,))
    assert (code, "at least 95%" in text) == (3, True)
    code, text = judged(0, (LIVES,))
    assert (code, "listed, but does not survive" in text) == (3, True)
    assert judged(0, (LIVES,), sample=True)[0] == 0


def test_a_group_that_is_none_is_an_error_that_names_those_there(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert mutants.main(["--group", "nobody", "--out", str(tmp_path)]) == 2
    assert "unknown; use one of holding, joint, planner" in capsys.readouterr().out
