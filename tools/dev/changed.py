"""Tests that a change can have touched: `./deploy/test --changed`, and the plugin it runs with.

By imports, and by names of data files in a module's text. A test file that names what changed runs
whole; of one that reaches it through other modules the first test runs. Nine changes in ten are
through in a minute and a half on two cores, where all that they reach takes eight.
"""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from shared.exceptions import RunError

ROOT: Final = Path(__file__).resolve().parents[2]
TOPS: Final = ("services", "shared", "tools", "tests", "examples")


class Selection(NamedTuple):
    """Test files, relative to the root."""

    whole: tuple[str, ...]
    first: tuple[str, ...]
    """Files of which only the first test runs."""


def changed_since(revision: str) -> set[str]:
    """Return the files that differ from a revision, also new ones that git does not know."""
    lists = (
        ("diff", "--name-only", "--no-renames", revision, "--"),
        ("ls-files", "--others", "--exclude-standard"),
    )
    found = set[str]()
    for words in lists:
        try:
            done = subprocess.run(
                ("git", *words), cwd=ROOT, capture_output=True, text=True, check=False
            )
        except FileNotFoundError:
            raise RunError(f"--changed {revision}: there is no git here to say it") from None
        if done.returncode:
            raise RunError(f"--changed {revision}: {done.stderr.strip().partition(chr(10))[0]}")
        found.update(done.stdout.splitlines())
    return found


def selection(changed: set[str], root: Path = ROOT) -> Selection:
    """Return the test files that a change of these files can have touched."""
    texts = {
        path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
        for top in TOPS
        for path in sorted((root / top).rglob("*.py"))
    }
    data = {name: _spoken(Path(name)) for name in changed if not name.endswith(".py")}
    names = {
        file: {
            *_imported(file, text, texts),
            *(name for name, last in data.items() if last in text),
        }
        for file, text in texts.items()
    }
    users: dict[str, set[str]] = {}
    for file, named in names.items():
        for name in named:
            users.setdefault(name, set()).add(file)
    reached, fresh = set(changed), set(changed)
    while fresh:
        fresh = {user for name in fresh for user in users.get(name, ())} - reached
        reached |= fresh
    tests = [file for file in texts if Path(file).name.startswith("test_") and file in reached]
    whole = [file for file in tests if file in changed or names[file] & changed]
    return Selection(tuple(whole), tuple(file for file in tests if file not in set(whole)))


def _spoken(path: Path) -> str:
    """Return how a text names a data file: one like `deploy/test` with its folder."""
    return path.name if path.suffix else "/".join(path.parts[-2:])


def _imported(file: str, text: str, texts: Iterable[str]) -> set[str]:
    """Return the files that a module imports, also inside functions, and its `conftest.py`."""
    modules = set[str]()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    paths = {name.replace(".", "/") for name in modules}
    likely = {f"{path}.py" for path in paths} | {f"{path}/__init__.py" for path in paths}
    if file.startswith("tests/"):
        likely |= {(folder / "conftest.py").as_posix() for folder in Path(file).parents}
    return likely & set(texts) - {file}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Take the files of which only the first test is to run."""
    parser.addoption("--first-of", action="append", default=[], metavar="FILE")


@pytest.hookimpl(trylast=True)  # after `-m`
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave the others out."""
    short = {ROOT / name for name in config.getoption("--first-of")}
    met, kept, left = set[Path](), list[pytest.Item](), list[pytest.Item]()
    for item in items:
        (left if item.path in met else kept).append(item)
        if item.path in short:
            met.add(item.path)
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = kept
