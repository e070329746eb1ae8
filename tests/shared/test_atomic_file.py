"""What is written is there whole or not at all."""

from __future__ import annotations

import ast
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from shared.atomic_file import atomic_file, replace_file

ROOT = Path(__file__).parents[2]
FULL_AT = 1000


def test_a_file_takes_its_place_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "x"
    with atomic_file(path, lasting=True) as file:
        file.write(b"half")
        assert not path.exists()
        file.write(b" and half")
    assert path.read_bytes() == b"half and half"
    assert list(tmp_path.iterdir()) == [path]


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


def test_what_a_kill_left_is_in_nobodys_way(tmp_path: Path) -> None:
    (tmp_path / ".x.part").write_bytes(b"half of an earlier one, and longer")
    replace_file(tmp_path / "x", b"new")
    assert (tmp_path / "x").read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_an_exclusive_file_replaces_none_also_if_it_comes_meanwhile(tmp_path: Path) -> None:
    path = tmp_path / "x"
    with pytest.raises(FileExistsError), atomic_file(path, exclusive=True) as file:  # noqa: PT012
        file.write(b"mine")
        path.write_bytes(b"another's")
    assert path.read_bytes() == b"another's"
    with pytest.raises(FileExistsError), atomic_file(path, exclusive=True):
        pytest.fail("is begun")


def test_a_private_file_is_for_its_user_alone(tmp_path: Path) -> None:
    replace_file(tmp_path / "x", b"", private=True)
    assert (tmp_path / "x").stat().st_mode & 0o777 == 0o600


def small_disk() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (FULL_AT, FULL_AT))


def test_a_full_disk_is_one_line_with_the_files_name(tmp_path: Path) -> None:
    code = "from pathlib import Path; from shared.atomic_file import replace_file; "
    code += f"replace_file(Path({str(tmp_path / 'x')!r}), bytes({2 * FULL_AT}))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, preexec_fn=small_disk, capture_output=True,
        text=True, check=False, timeout=60.0,
    )  # fmt: skip
    assert done.returncode == 1
    assert str(tmp_path / "x") in done.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


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
