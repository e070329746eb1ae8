"""Files of our own: written whole or not at all, read in any encoding, found for any user."""

from __future__ import annotations

import ast
import codecs
import json
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import revision
from shared.atomic_file import atomic_file, replace_file
from shared.exceptions import XrlError
from shared.places import in_home
from shared.toml_file import decoded

ROOT = Path(__file__).parents[2]


def test_a_file_takes_its_place_when_it_is_whole_whatever_a_kill_left(tmp_path: Path) -> None:
    path = tmp_path / "x"
    with atomic_file(path, lasting=True) as file:
        file.write(b"half")
        assert not path.exists()
        file.write(b" and half")
    assert path.read_bytes() == b"half and half"
    assert list(tmp_path.iterdir()) == [path]
    (tmp_path / "x").unlink()
    (tmp_path / ".x.part").write_bytes(b"half of an earlier one, and longer")
    replace_file(tmp_path / "x", b"new")
    assert (tmp_path / "x").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, OSError(28, "full"), ValueError])
def test_what_interrupts_a_writer_leaves_what_was_there_and_nothing_else(
    tmp_path: Path, error: BaseException
) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"old")
    kind = error if isinstance(error, type) else type(error)
    with pytest.raises(kind) as caught, atomic_file(path) as file:  # noqa: PT012
        file.write(b"half")
        raise error
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    assert kind is not OSError or getattr(caught.value, "filename", "") == str(path)


def test_an_exclusive_file_replaces_none_and_a_private_one_is_its_users_alone(
    tmp_path: Path,
) -> None:
    path = tmp_path / "x"
    with pytest.raises(FileExistsError), atomic_file(path, exclusive=True) as file:  # noqa: PT012
        file.write(b"mine")
        path.write_bytes(b"another's")
    assert path.read_bytes() == b"another's"
    with pytest.raises(FileExistsError), atomic_file(path, exclusive=True):
        pytest.fail("is begun")
    (tmp_path / "x").unlink()
    replace_file(tmp_path / "x", b"", private=True)
    assert (tmp_path / "x").stat().st_mode & 0o777 == 0o600


WRITERS = {
    "tools/export/tables.py": "in a folder that is there whole or not at all",
    "tools/fleet/run_dir.py": "of a fleet that runs",
    "tools/fleet/supervise.py": "of a fleet that runs",
    "tools/graph_libraries.py": "in a folder for the compiler",
    "tools/dev/mutants.py": "the source itself",
    "tools/output.py": "into an atomic file",
    "tools/dev/reference/__main__.py": "pages in the checkout",
    "tools/verbs/new.py": "in a folder that is there whole or not at all",
    "tools/view/serving.py": "what a server says",
    "tools/lab/studies/sweeps/table.py": "rows of a study that goes on after a kill",
}
"""Modules of tools that write to files by themselves, and why they may."""


def test_tools_write_their_results_by_atomic_file_alone() -> None:
    found = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "tools").rglob("*.py")
        if any(_writes(node) for node in ast.walk(ast.parse(path.read_text())))
    }
    assert found <= set(WRITERS)


def _writes(node: ast.AST) -> bool:
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
        return False
    if node.func.attr in ("write_text", "write_bytes", "savefig"):
        return True
    modes = [a.value for a in node.args if isinstance(a, ast.Constant)]
    return node.func.attr == "open" and any(
        isinstance(mode, str) and set(mode) & set("wxa") and len(mode) <= 3 for mode in modes
    )


@given(st.text())
def test_a_byte_order_mark_says_nothing(text: str) -> None:
    assert decoded(text.encode()).removeprefix("\ufeff") == text.removeprefix("\ufeff")
    assert decoded(codecs.BOM_UTF8 + text.encode()) == text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("a = 1".encode("UTF-16"), "is UTF-16; save it as UTF-8"),
        ("a = 1".encode("UTF-32"), "is UTF-32; save it as UTF-8"),
        (b"a = 1\nb = 'caf\xe9'", "byte 0xe9 in line 2"),
    ],
)
def test_another_encoding_is_named_and_what_is_no_text_is_told_with_its_line(
    content: bytes, words: str
) -> None:
    with pytest.raises(UnicodeError, match=words):
        decoded(content)


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


def test_a_checkout_or_a_wheel_says_what_it_was_built_from(checkout: Path) -> None:
    found = revision.code(checkout)
    assert (len(found["git_commit"]), found["git_dirty"]) == (40, "false")
    (checkout / "file").write_text("two")
    assert revision.code(checkout)["git_dirty"] == "true"
    found = {"git_commit": 40 * "a", "git_dirty": "true"}
    note = checkout / revision.BUILT_FROM
    note.parent.mkdir(parents=True)
    note.write_text(json.dumps(found))
    assert revision.code(checkout) == found
    assert revision.in_words(found) == "commit aaaaaaaaaaaa with changes"


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


def test_a_home_is_filled_in_or_the_path_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/anna")
    assert in_home("~/.config") == Path("/home/anna/.config")
    assert in_home("/etc/~x") == Path("/etc/~x")
    with pytest.raises(XrlError, match=r"~nobody-of-this-name/x: .* set HOME"):
        in_home("~nobody-of-this-name/x")

    def unknown(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", unknown)
    with pytest.raises(XrlError, match=r"~/x: .* set HOME, or use an absolute path"):
        in_home("~/x")
