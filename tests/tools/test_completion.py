"""`xrl completion`: what bash offers for a line that is half typed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tools.verb_table import VERBS


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "xrl.bash"
    words = [sys.executable, "-m", "tools.cli", "completion", "bash"]
    done = subprocess.run(words, capture_output=True, check=True)
    path.write_bytes(done.stdout)
    return path


def offered(script: Path, line: str, folder: Path) -> set[str]:
    """Return what bash offers for the last word of a line."""
    words = line.split(" ")
    listed = " ".join(f"'{word}'" for word in words)
    text = f"""
source {script}
COMP_WORDS=({listed}); COMP_CWORD={len(words) - 1}; COMP_LINE='{line}'; COMP_POINT={len(line)}
complete -p xrl >/dev/null || exit 3
$(complete -p xrl | sed 's/.*-F \\([^ ]*\\).*/\\1/') xrl "${{COMP_WORDS[-1]}}" "${{COMP_WORDS[-2]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(
        ["bash", "-c", text], capture_output=True, text=True, check=True, cwd=folder
    )
    return {word.strip() for word in done.stdout.splitlines() if word.strip()}


def test_every_verb_is_offered(script: Path, tmp_path: Path) -> None:
    assert offered(script, "xrl ", tmp_path) >= {verb.name.split()[0] for verb in VERBS}
    assert offered(script, "xrl log re", tmp_path) == {"report", "recover", "resim"}


def test_a_verbs_options_and_actions_are_offered(script: Path, tmp_path: Path) -> None:
    assert "--plant" in offered(script, "xrl sim --pl", tmp_path)
    assert "check" in offered(script, "xrl ros2 ", tmp_path)
    assert offered(script, "xrl study robust --be", tmp_path) == {"--beyond"}
    assert offered(script, "xrl completion ", tmp_path) >= {"bash", "zsh"}


def test_files_are_offered_where_a_verb_takes_one(script: Path, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").touch()
    assert offered(script, "xrl log report ru", tmp_path) == {"run.mcap"}
