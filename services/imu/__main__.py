"""`python -m services.imu`: the service of the IMU on the torso."""

from __future__ import annotations

from pathlib import Path

from services.imu.attitude import AttitudeLaw
from services.imu.loop import ImuLoop
from shared import log, process, scheduling
from shared.bus import session as bus
from shared.bus import topics
from shared.bus.messages import Attitude
from shared.can.can_sensor import CanSensor, pause_ns
from shared.can.imu_can import ImuAssembler, ImuSample
from shared.can.sensor_loop import run
from shared.config.files import load
from shared.config.robot_config import RobotConfig, expand


def main() -> int:
    """Run the service until SIGTERM or SIGINT; return the exit code."""
    parser = process.service_parser(__doc__ or "", "python -m services.imu")
    process.add_injected(parser)
    arguments = parser.parse_args()
    logger = log.setup("imu")
    config = load(arguments.config)
    sensor = make_sensor(config, arguments.run_dir)
    law = AttitudeLaw(config.imu)
    stop = process.StopFlag()
    granted = scheduling.apply("imu")
    with bus.open_session(config, "imu", arguments.run_dir, injected=arguments.injected) as session:
        loop = ImuLoop(sensor, law, session.publisher(topics.ATTITUDE, Attitude))
        logger.info("started at %g Hz, priority %s", config.imu.rate_hz, granted)
        process.freeze_garbage()
        run(loop, config.imu.rate_hz, stop)
    sensor.close()
    logger.info(
        "stopped: %d cycles, %d skipped, %d unsent, link opened %d times; "
        "samples not of unit length %d, frames malformed %d",
        loop.cycles,
        loop.skipped,
        loop.unsent,
        sensor.opened,
        law.refused,
        sensor.malformed,
    )
    return 0


def make_sensor(config: RobotConfig, run_dir: Path) -> CanSensor[ImuSample]:
    """Return the sensor on the bus that the robot file names."""
    imu = config.imu
    link = config.can[imu.bus]
    channel, pause = expand(link.channel, run_dir), pause_ns(imu.stale_ms, imu.rate_hz)
    return CanSensor(link.interface, channel, ImuAssembler(), pause_ns=pause)


if __name__ == "__main__":
    process.run_service(main)
