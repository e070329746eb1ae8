"""`python -m services.harness`: the harness sensor's service."""

from __future__ import annotations

from pathlib import Path

from services.harness.filter import WrenchFilter
from services.harness.loop import HarnessLoop
from shared import process
from shared.bus import topics
from shared.bus.messages import TareRequest, Vector6, Wrench
from shared.bus.session import Session
from shared.can.can_sensor import CanSensor, pause_ns
from shared.can.loadcell_can import SampleAssembler
from shared.can.sensor_service import SensorService, serve
from shared.config.robot_config import RobotConfig, expand


def main() -> int:
    """Run the service until SIGTERM or SIGINT; return the exit code."""
    return serve("harness", __doc__ or "", made)


def made(config: RobotConfig, run_dir: Path) -> SensorService:
    """Return the service of the robot's sensor; ConfigError if its geometry is singular."""
    sensor, law = make_sensor(config, run_dir), WrenchFilter(config.harness)

    def loop_on(session: Session) -> HarnessLoop:
        wrenches = session.publisher(topics.WRENCH, Wrench)
        return HarnessLoop(sensor, law, wrenches, session.latest(topics.HARNESS_TARE, TareRequest))

    return SensorService(config.harness.rate_hz, sensor, loop_on, "finite")


def make_sensor(config: RobotConfig, run_dir: Path) -> CanSensor[Vector6]:
    """Return the load-cell amplifier on the bus that the robot file names."""
    harness = config.harness
    link = config.can[harness.bus]
    channel, pause = expand(link.channel, run_dir), pause_ns(harness.stale_ms, harness.rate_hz)
    return CanSensor(link.interface, channel, SampleAssembler(), pause_ns=pause)


if __name__ == "__main__":
    process.run_service(main)
