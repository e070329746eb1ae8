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


def test_a_clean_checkout_has_a_commit_and_is_not_dirty(checkout: Path) -> None:
    found = revision.code(checkout)
    assert len(found["git_commit"]) == 40
    assert found["git_dirty"] == "false"


def test_a_changed_file_makes_the_checkout_dirty(checkout: Path) -> None:
    (checkout / "file").write_text("two")
    assert revision.code(checkout)["git_dirty"] == "true"


def test_a_directory_inside_another_checkout_is_unknown(checkout: Path) -> None:
    installed = checkout / "site-packages"
    installed.mkdir()
    assert revision.code(installed) == {"git_commit": "unknown", "git_dirty": "unknown"}


def test_a_checkout_without_a_commit_is_unknown(tmp_path: Path) -> None:
    git(tmp_path, "init", "--quiet")
    assert revision.code(tmp_path)["git_commit"] == "unknown"


def test_without_git_the_code_is_unknown(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert revision.code(checkout)["git_commit"] == "unknown"


def test_a_wheel_says_what_it_was_built_from_wherever_it_is_installed(checkout: Path) -> None:
    found = {"git_commit": 40 * "a", "git_dirty": "true"}
    note = checkout / revision.BUILT_FROM
    note.parent.mkdir(parents=True)
    note.write_text(json.dumps(found))
    assert revision.code(checkout) == found
    assert revision.in_words(found) == "commit aaaaaaaaaaaa with changes"


def test_a_wheel_of_no_known_origin_says_so(tmp_path: Path) -> None:
    assert revision.in_words(revision.code(tmp_path)) == "commit unknown"
