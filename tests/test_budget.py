"""The size budget of pyproject.toml's [tool.xrl.budget]: a room that grows says so there."""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BUDGET = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["xrl"][
    "budget"
]
ROOMS: dict[str, int] = BUDGET["lines"]
ROOM = 1.1
"""A room that has shrunk below its budget by more than this factor gives the rest back."""


def files_of(room: str) -> list[Path]:
    """Return a room's files; a room below it in the table has its own budget."""
    below = tuple(f"{other}/" for other in ROOMS if other.startswith(f"{room}/"))
    paths = [path.relative_to(ROOT).as_posix() for path in (ROOT / room).rglob("*.py")]
    return [ROOT / path for path in sorted(paths) if not path.startswith(below or ("/",))]


def lines_of(room: str) -> int:
    return sum(len(path.read_bytes().splitlines()) for path in files_of(room))


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_keeps_its_budget_of_lines(room: str) -> None:
    lines, most = lines_of(room), ROOMS[room]
    assert lines <= most, f"{room} has {lines} lines: delete {lines - most}, or say why in a commit"
    assert lines * ROOM + 20 > most, f"{room} has {lines} lines: lower its budget from {most}"


def test_every_file_has_a_budget() -> None:
    counted = {path for room in ROOMS for path in files_of(room)}
    rooms = ("services", "shared", "tools", "examples", "tests")
    assert {path for room in rooms for path in (ROOT / room).rglob("*.py")} == counted


def test_the_public_names_keep_their_budget() -> None:
    names = [
        node.name
        for room in ("services", "shared", "tools")
        for path in (ROOT / room).rglob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_")
    ]
    assert len(names) <= BUDGET["names"]
    assert len(names) * ROOM > BUDGET["names"], "lower the budget"
