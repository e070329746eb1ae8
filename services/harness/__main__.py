"""`python -m services.harness`: the harness sensor's service."""

from __future__ import annotations

from pathlib import Path

from services.harness.filter import WrenchFilter
from services.harness.loop import HarnessLoop
from services.harness.sensor import CanHarnessSensor
from shared import log, process, scheduling
from shared.bus import session as bus
from shared.bus import topics
from shared.bus.messages import TareRequest, Wrench
from shared.can.can_sensor import pause_ns
from shared.can.sensor_loop import run
from shared.config.files import load
from shared.config.robot_config import RobotConfig, expand


def main() -> int:
    """Run the service until SIGTERM or SIGINT; return the exit code."""
    parser = process.service_parser(__doc__ or "", "python -m services.harness")
    process.add_injected(parser)
    arguments = parser.parse_args()
    logger = log.setup("harness")
    config = load(arguments.config)
    sensor = make_sensor(config, arguments.run_dir)
    law = WrenchFilter(config.harness)
    stop = process.StopFlag()
    granted = scheduling.apply("harness")
    with bus.open_session(
        config, "harness", arguments.run_dir, injected=arguments.injected
    ) as session:
        wrenches = session.publisher(topics.WRENCH, Wrench)
        requests = session.latest(topics.HARNESS_TARE, TareRequest)
        loop = HarnessLoop(sensor, law, wrenches, requests)
        logger.info("started at %g Hz, priority %s", config.harness.rate_hz, granted)
        process.freeze_garbage()
        run(loop, config.harness.rate_hz, stop)
    sensor.close()
    logger.info(
        "stopped: %d cycles, %d skipped, %d unsent, link opened %d times; "
        "samples not finite %d, frames malformed %d",
        loop.cycles,
        loop.skipped,
        loop.unsent,
        sensor.opened,
        loop.state.refused,
        sensor.malformed,
    )
    return 0


def make_sensor(config: RobotConfig, run_dir: Path) -> CanHarnessSensor:
    """Return the sensor on the bus that the robot file names."""
    harness = config.harness
    link = config.can[harness.bus]
    pause = pause_ns(harness.stale_ms, harness.rate_hz)
    return CanHarnessSensor(link.interface, expand(link.channel, run_dir), pause_ns=pause)


if __name__ == "__main__":
    process.run_service(main)
