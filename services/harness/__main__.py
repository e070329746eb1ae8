"""`python -m services.harness`: the harness sensor's service."""

from __future__ import annotations

import os
from pathlib import Path

from services.harness.filter import WrenchFilter
from services.harness.loop import HarnessLoop, ZeroFile
from shared import process
from shared.bus import topics
from shared.bus.messages import TareRequest, Wrench
from shared.bus.session import Session
from shared.can.can_sensor import sensor_of
from shared.can.sensor_frames import SampleAssembler
from shared.can.sensor_service import SensorService, serve
from shared.config.robot_config import RobotConfig
from shared.run_directory import FLEET_VARIABLE


def main() -> int:
    """Run the service until SIGTERM or SIGINT; return the exit code."""
    return serve("harness", __doc__ or "", made)


def made(config: RobotConfig, run_dir: Path) -> SensorService:
    """Return the service of the robot's sensor; raise ConfigError if its geometry is singular."""
    harness = config.harness
    sensor = sensor_of(config, harness, SampleAssembler(), run_dir)
    law = WrenchFilter(harness)
    # a service started by hand stores no zero, because nothing would remove the file
    zero = ZeroFile(run_dir) if FLEET_VARIABLE in os.environ else None

    def loop_on(session: Session) -> HarnessLoop:
        wrenches = session.publisher(topics.WRENCH, Wrench)
        requests = session.latest(topics.HARNESS_TARE, TareRequest)
        return HarnessLoop(sensor, law, wrenches, requests, zero)

    return SensorService(harness.rate_hz, sensor, loop_on, "finite")


if __name__ == "__main__":
    process.run_service(main)
