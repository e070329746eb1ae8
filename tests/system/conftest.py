"""Live fleets need two cores that keep up: shown once, before the first test that leads one."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Final

import pytest

LED: Final = {
    "test_agreement", "test_crashtest", "test_demo", "test_hosts", "test_injector",
    "test_namespaces", "test_old_commands", "test_play", "test_supervision", "test_usb_fleet",
    "test_zero_and_jog",
}  # fmt: skip
"""Files whose tests start the ten processes and wait until the planner leads."""
TRIES: Final = 2
IDLE_LEAST: Final = 0.08
"""Of two cores, while a fleet runs: a good machine leaves a quarter idle."""
NOT_LED: Final = "not all six modules track"


def idle_and_total() -> tuple[int, int]:
    """Return the idle and all ticks of every core since the machine started."""
    fields = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:]
    ticks = [int(field) for field in fields]
    return ticks[3] + ticks[4], sum(ticks)


@cache
def too_slow() -> str:
    """Return why no fleet can be led here now, in words; "" if one was.

    On the controllers' own plant, the cheapest: what a realistic one costs beyond it is for the
    tests to show. A fleet that is not led though the cores had time to spare is no matter of
    the machine, and goes on to fail them.
    """
    idle = 1.0
    for _ in range(TRIES):
        before = idle_and_total()
        command = [sys.executable, "-m", "tools.cli", "demo", "--scenario", "stand"]
        with tempfile.TemporaryDirectory() as folder:
            out = ["--duration", "1", "--plant", "ideal", "--out", f"{folder}/run"]
            done = subprocess.run(
                [*command, *out], capture_output=True, text=True, timeout=150, check=False
            )
        after = idle_and_total()
        idle = (after[0] - before[0]) / max(1, after[1] - before[1])
        if NOT_LED not in done.stderr:
            return ""
        if idle > IDLE_LEAST:
            return ""
    return f"this machine cannot carry a fleet now: {100 * idle:.0f} % idle, and none was led"


def pytest_collection_finish(session: pytest.Session) -> None:
    """Look before the first test, so that no test's own time is spent on it."""
    if not session.config.option.collectonly and any(
        item.path.stem in LED for item in session.items
    ):
        too_slow()


@pytest.fixture(autouse=True)
def _machine_keeps_up(request: pytest.FixtureRequest) -> None:
    if Path(str(request.path)).stem in LED and (why := too_slow()):
        pytest.skip(why)
