from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.simulator.fronts.unix_can_hub import UnixCanHub
from shared.bus import topics
from shared.bus.messages import Attitude
from shared.bus.session import open_session
from shared.can import imu_can
from shared.config.files import load, to_toml
from shared.config.gain_schedule import path_beside, write
from shared.config.robot_config import RobotConfig
from tests.imu.robots import with_imu

pytestmark = pytest.mark.system


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as directory:
        yield Path(directory)


def test_the_service_publishes_which_way_is_up_and_invalid_once_the_sensor_is_silent(
    robot: RobotConfig, run_dir: Path
) -> None:
    fitted, file = with_imu(robot), run_dir / "robot.toml"
    file.write_text(to_toml(fitted), encoding="utf-8")
    assert fitted.gain_schedule is not None
    write(path_beside(file), fitted.gain_schedule)
    command = [sys.executable, "-m", "services.imu", "--config", str(file)]
    tilted = (math.cos(0.05), math.sin(0.05), 0.0, 0.0)
    taken: list[Attitude] = []
    with (
        UnixCanHub(run_dir / "can_imu.sock") as hub,
        open_session(load(file), "test", run_dir) as session,
        subprocess.Popen(
            [*command, "--run-dir", str(run_dir)], stderr=subprocess.PIPE, text=True
        ) as service,
    ):
        try:
            attitudes = session.latest(topics.ATTITUDE, Attitude)
            give_up = time.monotonic() + 20.0
            while not (taken and taken[-1].valid):
                assert time.monotonic() < give_up
                hub.poll()
                hub.broadcast(imu_can.pack(tilted, (0.0, 0.0, 0.0), valid=True))
                taken += filter(None, [attitudes.take()])
                time.sleep(0.01)
            attitude = taken[-1]
            while taken[-1].valid:
                assert time.monotonic() < give_up
                taken += filter(None, [attitudes.take()])
                time.sleep(0.01)
            service.terminate()
            log = service.communicate(timeout=10.0)[1]
        finally:
            service.kill()
    assert service.returncode == 0, log
    assert "stopped:" in log
    assert attitude.up == pytest.approx((0.0, math.sin(0.1), math.cos(0.1)), abs=1e-3)
    assert taken[-1].up == attitude.up, "the last good one"
