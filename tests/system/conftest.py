"""Live fleets run as fast as this machine carries them: found out before the first test of one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.system.stalls import FILE_VARIABLE, start_watch
from tools.fleet.pace import PACE_VARIABLE, SLOWER, usual_pace

FULL: Final = 0.75
"""Fraction of all cores: a fleet that takes more drops out now and then, and its tests with it."""

CROWDED: Final = {"test_hosts_verb": 0.6, "test_namespaces": 0.6, "test_usb_fleet": 0.6}
"""Factor on the pace of those with several hosts, or with boards that take more of the cores than
axes on CAN: other tests run beside them."""


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
        if not (out / "summary.json").exists():
            return ""
        summary = json.loads((out / "summary.json").read_text())
        full = summary["fleet_cpu_pct"] > FULL * 100.0 * (os.cpu_count() or 1)
        return f"{summary['pace'] * (SLOWER if full else 1.0):g}"


@pytest.fixture(scope="module", autouse=True)
def _slowed(request: pytest.FixtureRequest) -> Iterator[None]:
    """Let a fleet that crowds the cores run in slow motion."""
    factor = CROWDED.get(request.path.stem)
    with pytest.MonkeyPatch.context() as patch:
        if factor is not None:
            patch.setenv(PACE_VARIABLE, f"{factor * usual_pace():g}")
        yield


def pytest_collection_finish(session: pytest.Session) -> None:
    """Look before the first test, so that no test's own time is spent on it."""
    live = any(item.get_closest_marker("live") for item in session.items)
    if not live or session.config.option.collectonly:
        return
    if PACE_VARIABLE not in os.environ and (pace := carried_pace()):
        os.environ[PACE_VARIABLE] = pace
    if FILE_VARIABLE not in os.environ:
        start_watch()
