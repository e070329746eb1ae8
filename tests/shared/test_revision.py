from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from shared import revision


def git(root: Path, *arguments: str) -> None:
    who = ("-c", "user.name=t", "-c", "user.email=t@example.invalid", "-c", "commit.gpgsign=false")
    subprocess.run(("git", "-C", str(root), *who, *arguments), check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    git(tmp_path, "init", "--quiet")
    (tmp_path / "file").write_text("one")
    git(tmp_path, "add", "file")
    git(tmp_path, "commit", "--quiet", "--message", "one")
    return tmp_path


def test_a_checkout_has_a_commit_and_is_dirty_once_a_file_is_changed(checkout: Path) -> None:
    found = revision.code(checkout)
    assert (len(found["git_commit"]), found["git_dirty"]) == (40, "false")
    (checkout / "file").write_text("two")
    assert revision.code(checkout)["git_dirty"] == "true"


def test_inside_another_checkout_without_a_commit_or_without_git_it_is_unknown(
    checkout: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed, empty = checkout / "site-packages", tmp_path_factory.mktemp("empty")
    installed.mkdir()
    git(empty, "init", "--quiet")
    unknown = {"git_commit": "unknown", "git_dirty": "unknown"}
    assert revision.code(installed) == revision.code(empty) == unknown
    assert revision.in_words(unknown) == "commit unknown"
    monkeypatch.setenv("PATH", "")
    assert revision.code(checkout) == unknown


def test_a_wheel_says_what_it_was_built_from_wherever_it_is_installed(checkout: Path) -> None:
    found = {"git_commit": 40 * "a", "git_dirty": "true"}
    note = checkout / revision.BUILT_FROM
    note.parent.mkdir(parents=True)
    note.write_text(json.dumps(found))
    assert revision.code(checkout) == found
    assert revision.in_words(found) == "commit aaaaaaaaaaaa with changes"
