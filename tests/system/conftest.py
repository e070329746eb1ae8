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

LED: Final = {
    "test_agreement", "test_crashtest", "test_demo", "test_estop_live", "test_floods",
    "test_hosts_verb", "test_identify_live", "test_namespaces",
    "test_old_commands", "test_ros2", "test_usb_fleet", "test_view_live", "test_zero_and_jog",
}  # fmt: skip
"""Files whose tests start services that hold or lead the simulated robot: one after the other."""

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


def _is_led(item: pytest.Item) -> bool:
    """Return True for a test of this folder that leads a fleet; others may have files so named."""
    return item.path.parent == Path(__file__).parent and item.path.stem in LED


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that need the cores to themselves."""
    for item in items:
        if _is_led(item):
            item.add_marker(pytest.mark.live)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Look before the first test, so that no test's own time is spent on it."""
    led = any(map(_is_led, session.items))
    if led and not session.config.option.collectonly and PACE_VARIABLE not in os.environ:
        pace = carried_pace()
        if pace:
            os.environ[PACE_VARIABLE] = pace
    if led and not session.config.option.collectonly and FILE_VARIABLE not in os.environ:
        start_watch()
