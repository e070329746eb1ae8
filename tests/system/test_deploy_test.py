"""The script that runs all checks: what it says of failures, and that Ctrl-C ends all of it.

In a copy of `deploy` with an environment of its own, whose tools only say that they were called;
what runs them is the real one.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from shared.places import CHECKOUT

pytestmark = [pytest.mark.system, pytest.mark.timeout(60)]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Return a project of which nothing is there but its scripts and what they make it from."""
    shutil.copytree(CHECKOUT / "deploy", tmp_path / "deploy")
    for name in ("requirements.lock", "requirements.runtime.lock", "pyproject.toml"):
        shutil.copy(CHECKOUT / name, tmp_path)
    (tmp_path / ".venv/bin").mkdir(parents=True)
    subprocess.run(
        ["bash", "-c", "source deploy/lib.sh; fingerprint requirements.lock >.venv/xrl.stamp"],
        cwd=tmp_path,
        check=True,
    )
    for name in ("python", "ruff", "mypy", "pytest"):
        write_tool(tmp_path, name, f"echo {name} called: $*")
    return tmp_path


def write_tool(root: Path, name: str, body: str) -> None:
    tool = root / ".venv/bin" / name
    checks = (
        f'[[ "$*" != "-m tools.dev.checks"* ]] || {{ cd {CHECKOUT}; exec {sys.executable} "$@"; }}'
    )
    tool.write_text(f"#!/usr/bin/env bash\n{checks}\n{body}\n")
    tool.chmod(0o755)


def start(root: Path, *words: str, background: bool = False) -> subprocess.Popen[str]:
    """Start the script as a terminal does: in a process group of its own.

    Args:
        root: the project.
        words: arguments.
        background: as a shell without job control starts it with `&`: Ctrl-C's signal is ignored.
    """

    def ignore() -> None:
        if background:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    return subprocess.Popen(
        ["bash", "deploy/test", *words],
        cwd=root,
        env={**os.environ, "TMPDIR": str(root)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        preexec_fn=ignore,  # noqa: PLW1509 - no thread of this test holds a lock
    )


def run(root: Path, *words: str) -> tuple[int, str]:
    script = start(root, *words)
    said, _ = script.communicate(timeout=30)
    return script.returncode, said


def test_all_parts_are_run_and_success_is_exit_code_0(root: Path) -> None:
    code, said = run(root)
    assert code == 0
    assert said.count("ruff called") == 2
    assert said.count("mypy called") == 1
    assert re.findall(r"^pytest called: .*? -m (.*?)(?: tests| --num)", said, re.M) == [
        "live and not wide",
        "system and not live",
        "not system and not wide",
    ], "what runs beside the others is shown last"
    assert said.count("python called: -m tools.dev.mutants --sample") == 1
    assert said.count("python called: -m tools.graph_libraries") == 1
    assert "graph_libraries" not in run(root)[1], "what is translated is not translated again"


def test_what_runs_beside_live_fleets_gives_way_to_them(root: Path) -> None:
    write_tool(root, "pytest", "echo policy $(cut -d' ' -f41 /proc/$$/stat) of $*")
    _, said = run(root)
    normal, idle = str(os.SCHED_OTHER), str(os.SCHED_IDLE)
    assert re.findall(r"^policy (\d)", said, re.M) == [normal, normal, idle], (
        "that one is told last"
    )


@pytest.mark.parametrize("status", [1, 2], ids=["a failure", "a file that cannot be imported"])
def test_failures_are_listed_last_and_the_other_parts_are_run(root: Path, status: int) -> None:
    write_tool(root, "mypy", "exit 1")
    write_tool(root, "pytest", f"echo ERROR tests/test_x.py; echo one of $*; exit {status}")
    code, said = run(root)
    assert code == 3
    assert len(re.findall("^== pytest -m", said, re.M)) == 3
    last = said[said.index("== failed:") :]
    assert "== failed: mypy" in last
    assert last.count("== failed: ERROR tests/test_x.py") == 3


def test_the_last_line_says_what_ran_and_what_was_skipped_and_why(root: Path) -> None:
    skipped = "echo 'SKIPPED [4] tests/x.py:81: needs a Chromium'"
    write_tool(root, "pytest", f"{skipped}; {skipped}; echo '=== 9 passed, 8 skipped in 3.1s ==='")
    code, said = run(root)
    last = said.splitlines()[-1]
    assert code == 0
    assert re.match(
        r"== passed in 0 min \d+ s: ruff check, \d s; ruff format --check, \d s; mypy", last
    )
    assert "; 9 passed, 8 skipped in 3.1s (pytest -m 'live and not wide' tests/system); " in last
    assert last.endswith("; skipped: 24: needs a Chromium")
    write_tool(root, "pytest", "echo '=== 9 passed in 3.1s ==='")
    write_tool(root, "mypy", "exit 1")
    last = run(root)[1].splitlines()[-1]
    assert last.startswith("== FAILED in 0 min ")
    assert last.endswith("; skipped: nothing")


@pytest.mark.parametrize(("part", "background"), [("mypy", False), ("pytest", True)])
def test_ctrl_c_ends_all_of_it(root: Path, part: str, *, background: bool) -> None:
    """Whatever the part that it meets makes of it: pytest ends with 2, and not by the signal."""
    write_tool(root, part, f"trap 'kill $!; exit 2' INT\nsleep 30 &\necho {part} begins\nwait")
    script = start(root, background=background)
    assert script.stdout is not None
    output = ""
    while f"{part} begins" not in output:
        line = script.stdout.readline()
        assert line, output
        output += line
    os.killpg(script.pid, signal.SIGINT)
    rest, _ = script.communicate(timeout=30)
    assert script.returncode == 130
    assert "begins" not in rest
    assert not list(root.glob("tmp*")), "its files are gone"
