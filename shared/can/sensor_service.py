"""Process of a service that reads a sensor: one cycle per period until it is stopped."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from shared import log, process, scheduling
from shared.bus.session import Session, open_session
from shared.can.can_sensor import CanSensor
from shared.can.sensor_loop import SensorLoop
from shared.clock import NS_PER_S, now_ns, sleep_until
from shared.config.files import load
from shared.config.robot_config import RobotConfig


class SensorService(NamedTuple):
    """Parts that differ between the sensors' services."""

    rate_hz: float
    sensor: CanSensor[Any]
    loop_on: Callable[[Session], SensorLoop[Any, Any]]
    refused_for: str
    """Property that the refused samples lack, for the log."""


def serve(name: str, about: str, made: Callable[[RobotConfig, Path], SensorService]) -> int:
    """Run a service until SIGTERM or SIGINT; return the exit code.

    `made` constructs the service from the robot and the run directory; `about` is the text of
    `--help`.
    """
    parser = process.service_parser(about, f"python -m services.{name}")
    process.add_injected(parser)
    arguments = parser.parse_args()
    logger = log.setup(name)
    config = load(arguments.config)
    service = made(config, arguments.run_dir)
    sensor = service.sensor
    stop = process.StopFlag()
    granted = scheduling.apply(name)
    with open_session(config, name, arguments.run_dir, injected=arguments.injected) as session:
        loop = service.loop_on(session)
        logger.info("started at %g Hz, priority %s", service.rate_hz, granted)
        process.freeze_garbage()
        run(loop, service.rate_hz, stop)
    sensor.close()
    logger.info(
        "stopped: %d cycles, %d skipped, %d unsent; "
        "times the link was opened: %d, samples that were not %s: %d, malformed frames: %d",
        loop.cycles, loop.skipped, loop.unsent, sensor.opened,
        service.refused_for, loop.refused, sensor.malformed,
    )  # fmt: skip
    return 0


def next_deadline(deadline_ns: int, period_ns: int, now_ns: int) -> tuple[int, int]:
    """Return the next deadline after now, on the grid of periods, and the number missed."""
    missed = max(0, (now_ns - deadline_ns) // period_ns)
    return deadline_ns + (missed + 1) * period_ns, missed


def run(loop: SensorLoop[Any, Any], rate_hz: float, stop: process.StopFlag) -> None:
    """Run cycles at `rate_hz` until stopped; missed cycles are skipped."""
    period_ns = round(NS_PER_S / rate_hz)
    deadline_ns = now_ns()
    while not stop:
        loop.cycle(now_ns())
        deadline_ns, missed = next_deadline(deadline_ns, period_ns, now_ns())
        loop.skipped += missed
        sleep_until(deadline_ns)
