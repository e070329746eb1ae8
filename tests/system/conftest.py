"""Live fleets run as fast as this machine carries them: found out before the first test of one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import pytest

from tools.supervision.pace import PACE_VARIABLE

LED: Final = {
    "test_agreement", "test_crashtest", "test_demo", "test_hosts", "test_injector",
    "test_namespaces", "test_old_commands", "test_play", "test_supervision", "test_usb_fleet",
    "test_zero_and_jog",
}  # fmt: skip
"""Files whose tests start the ten processes and wait until the planner leads."""


def carried_pace() -> str:
    """Return the pace at which this machine carries a fleet, as `xrl demo` finds it; "" if none.

    Where none is, the tests that follow are to fail, each for itself.
    """
    command = [sys.executable, "-m", "tools.cli", "demo", "--scenario", "stand"]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        subprocess.run(
            [*command, "--duration", "1", "--out", str(out)],
            capture_output=True,
            timeout=240,
            check=False,
        )
        summary = out / "summary.json"
        return str(json.loads(summary.read_text())["pace"]) if summary.exists() else ""


def pytest_collection_finish(session: pytest.Session) -> None:
    """Look before the first test, so that no test's own time is spent on it."""
    led = any(item.path.stem in LED for item in session.items)
    if led and not session.config.option.collectonly and PACE_VARIABLE not in os.environ:
        pace = carried_pace()
        if pace:
            os.environ[PACE_VARIABLE] = pace
