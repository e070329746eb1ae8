"""`python -m services.imu`: the service of the IMU on the torso."""

from __future__ import annotations

from pathlib import Path

from services.imu.attitude import AttitudeLaw
from services.imu.loop import ImuLoop
from shared import process
from shared.bus import topics
from shared.bus.messages import Attitude
from shared.bus.session import Session
from shared.can.can_sensor import sensor_of
from shared.can.sensor_frames import ImuAssembler
from shared.can.sensor_service import SensorService, serve
from shared.config.robot_config import RobotConfig


def main() -> int:
    """Run the service until SIGTERM or SIGINT; return the exit code."""
    return serve("imu", __doc__ or "", made)


def made(config: RobotConfig, run_dir: Path) -> SensorService:
    """Return the service of the robot's IMU."""
    imu = config.imu
    sensor = sensor_of(config, imu, ImuAssembler(), run_dir)

    def loop_on(session: Session) -> ImuLoop:
        return ImuLoop(sensor, AttitudeLaw(imu), session.publisher(topics.ATTITUDE, Attitude))

    return SensorService(imu.rate_hz, sensor, loop_on, "of unit length")


if __name__ == "__main__":
    process.run_service(main)
