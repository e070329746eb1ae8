"""`examples/send_intent.py` beside a fleet that leads."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shared.bus import topics
from shared.bus.messages import PlannerMode, PlannerStatus
from shared.bus.session import open_session
from shared.config.robot_config import RobotConfig
from shared.process import DEFAULT_CONFIG
from shared.robot.joints import MODULES
from shared.run_directory import RUN_DIR_VARIABLE
from tools.fleet.supervise import SupervisedFleet

pytestmark = [pytest.mark.system, pytest.mark.live, pytest.mark.timeout(180)]

ROOT = DEFAULT_CONFIG.parents[1]
SCRIPT = ROOT / "examples" / "send_intent.py"


def wait_until_led(robot: RobotConfig, run_dir: Path) -> None:
    """Wait until the planner leads."""
    with open_session(robot, "test", run_dir) as session:
        statuses = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        deadline = time.monotonic() + 60.0
        while (status := statuses.take()) is None or status.mode != PlannerMode.LEADING:
            assert time.monotonic() < deadline, status
            time.sleep(0.01)


def test_the_planner_gives_the_assist_that_a_script_asks_for(
    run_dir: Path, robot: RobotConfig
) -> None:
    fleet = SupervisedFleet.start(
        DEFAULT_CONFIG, run_dir, services=["simulator", *MODULES, "harness", "planner"]
    )
    try:
        wait_until_led(robot, run_dir)
        done = subprocess.run(
            [sys.executable, SCRIPT],
            env=os.environ | {RUN_DIR_VARIABLE: str(run_dir)},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    finally:
        fleet.stop()
    assert done.returncode == 0, done.stderr
    words = done.stdout.split()
    assert words[:3] == ["the", "planner", "gives"]
    assert float(words[3]) > 20.0, done.stdout
