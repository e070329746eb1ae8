"""`xrl demo` with words that make no sense: a line, and no fleet."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--scenario", "flight"), "no scenario 'flight'"),
        (("--kill", "plannner@3"), "services:"),
        (("--kill", "planner@3:BLINK"), "signals:"),
        (("--kill", "planner@30"), "not inside the run"),
        (("--restart", "planner@3"), "kill it first"),
        (("--push", "1:2:3"), "START:DURATION:FX,FY,FZ"),
        (("--duration", "0"), "more than 0"),
        (("--config", "no_such.toml"), "not found"),
    ],
)
def test_bad_input_is_one_clear_line(tmp_path: Path, flags: tuple[str, ...], words: str) -> None:
    command = [sys.executable, "-m", "tools.cli", "demo", "--out", str(tmp_path / "out"), *flags]
    result = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False
    )
    assert result.returncode == 2
    assert words in result.stderr
    assert "Traceback" not in result.stderr
