"""`./deploy/test --changed`: which tests a change can have touched."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from shared.exceptions import RunError
from shared.places import CHECKOUT
from tools.dev import changed

FILES = {
    "shared/law.py": "GAIN = 1\n",
    "shared/fleet.py": "def run():\n    from shared import law\n",
    "shared/alone.py": "",
    "tests/conftest.py": "from shared.alone import x\n",
    "tests/test_law.py": "from shared import law\n",
    "tests/test_fleet.py": "import shared.fleet\n",
    "tests/test_other.py": "FILE = 'robot.toml'; SCRIPT = 'deploy/run'\n",
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("file", "whole", "first"),
    [
        ("shared/law.py", ["law"], ["fleet"]),
        ("shared/fleet.py", ["fleet"], []),
        ("shared/alone.py", [], ["fleet", "law", "other"]),
        ("tests/conftest.py", ["fleet", "law", "other"], []),
        ("tests/test_law.py", ["law"], []),
        ("deploy/robot.toml", ["other"], []),
        ("deploy/run", ["other"], []),
        ("docs/run", [], []),
        ("shared/gone.py", [], []),
    ],
)
def test_a_test_that_names_what_changed_runs_whole_and_one_that_reaches_it_once(
    file: str, whole: list[str], first: list[str], root: Path
) -> None:
    chosen = changed.selection({file}, root)
    assert sorted(chosen.whole) == [f"tests/test_{name}.py" for name in whole]
    assert sorted(chosen.first) == [f"tests/test_{name}.py" for name in first]


def test_git_says_what_changed_and_a_revision_that_it_lacks_is_refused(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(changed, "ROOT", root)
    git = ("git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(root))
    for words in (("init", "-q"), ("add", "-A"), ("commit", "-qm", "first")):
        subprocess.run((*git, *words), check=True)
    assert changed.changed_since("HEAD") == set()
    (root / "shared/law.py").write_text("GAIN = 2\n")
    (root / "tests/conftest.py").unlink()
    (root / "tests/test_new.py").write_text("")
    assert changed.changed_since("HEAD") == {
        "shared/law.py", "tests/conftest.py", "tests/test_new.py"
    }  # fmt: skip
    with pytest.raises(RunError, match="no-such-revision"):
        changed.changed_since("no-such-revision")


def test_of_a_file_that_only_reaches_it_the_first_test_that_is_chosen_runs(tmp_path: Path) -> None:
    here = "tests/safety/test_clocks.py", "tests/safety/test_stop.py"
    words = ["-p", "tools.dev.changed", "--collect-only", "-q", *here, f"--first-of={here[1]}"]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *words],
        cwd=CHECKOUT, capture_output=True, text=True, check=True, env={"TMPDIR": str(tmp_path)},
    )  # fmt: skip
    found = [line.partition("::")[0] for line in done.stdout.splitlines() if "::" in line]
    assert found.count(here[1]) == 1
    assert found.count(here[0]) > 1
