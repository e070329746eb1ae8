"""Load of a CAN bus with drives at 1 Mbit/s (docs/drives.md). Pure.

A standard data frame with n bytes is 47 + 8n bits long, including the gap after it. After five
equal bits the sender inserts a stuff bit, up to the end of the checksum: at most one per four of
the 34 + 8n bits. `STUFFING` was measured on this robot's frames.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError

BITRATE: Final = 1_000_000
"""bit/s"""
LOAD_MAX: Final = 0.85
"""Maximum planned load of a bus. Requests, arming and errors add to it, and on a full bus a frame
waits for all frames queued before it. Torques for 12 axes at 333 Hz, with heartbeats at 10 Hz, take
81 %."""
STUFFING: Final = 0.06
"""Stuff bits per bit that can be stuffed; 0.05 while the robot stands."""
BLEND_MAX: Final = 0.98
"""Maximum load of a bus while gains blend, for tenths of a second. Above it frames queue up, and
joints are controlled on old samples."""
GAINS_HZ: Final = 10.0
"""Rate at which the onboard loop's gains are sent when they do not change."""
BLEND_HZ: Final = 125.0
"""Rate of the gains while they blend: `GAIN_UPDATE_MIN_MS` of `services.joint.drive_setpoint`."""
LOADCELL_FRAMES: Final = 3
"""Frames per sample of the harness sensor."""


class _BusLoad(NamedTuple):
    """Load of a bus, as a fraction of its capacity."""

    steady: float
    blending: float
    """While gains blend."""

    @property
    def fits(self) -> bool:
        """True if the bus can carry it."""
        return self.steady <= LOAD_MAX and self.blending <= BLEND_MAX


def frame_bits(data_bytes: int) -> float:
    """Return the usual length of a standard data frame, bits."""
    return 47 + 8 * data_bytes + STUFFING * (34 + 8 * data_bytes)


def bus_load(
    axes: int,
    rate_hz: float,
    *,
    onboard: bool,
    heartbeat_period_ms: float,
    loadcell_rate_hz: float = 0.0,
) -> _BusLoad:
    """Return the load of a bus: per cycle, an estimate from each axis and a target to it.

    With `onboard`, each target has 8 bytes, and gains are sent too; otherwise each torque has 4
    bytes. `loadcell_rate_hz` is the sample rate of a harness sensor on this bus.
    """
    full, half = frame_bits(8), frame_bits(4)
    gains = full + half if onboard else 0.0
    cyclic = rate_hz * (full + (full if onboard else half)) + 1e3 / heartbeat_period_ms * full
    other = LOADCELL_FRAMES * loadcell_rate_hz * full
    steady, blending = (axes * (cyclic + hz * gains) + other for hz in (GAINS_HZ, BLEND_HZ))
    return _BusLoad(steady / BITRATE, blending / BITRATE)


def check_buses(file: str, config: RobotConfig) -> None:
    """Raise ConfigError if a bus cannot carry its modules; the error says how many it can carry."""
    service = config.joint_service
    if service.driver != "odrive_can":
        return
    buses: dict[str, list[str]] = {}
    for module in config.module:
        buses.setdefault(config.can[module.bus].channel, []).append(module.bus)
    sensor = config.can[config.harness.bus].channel
    for channel, names in buses.items():
        loads = [
            bus_load(
                2 * count,
                service.rate_hz,
                onboard=service.loop == "onboard",
                heartbeat_period_ms=config.drive.heartbeat_period_ms,
                loadcell_rate_hz=config.harness.rate_hz if channel == sensor else 0.0,
            )
            for count in range(1, len(names) + 1)
        ]
        load, carried = loads[-1], sum(load.fits for load in loads)
        if not load.fits:
            s, most_s = "s" * (len(names) != 1), "s" * (carried != 1)
            fewer = f"connect at most {carried} module{most_s} to a bus at this rate, or "
            raise ConfigError(
                file,
                f"can.{names[0]}",
                f"{len(names)} module{s} at {service.rate_hz:g} Hz would load the bus to "
                f"{load.steady:.0%} of 1 Mbit/s ({load.blending:.0%} while gains blend)",
                f"must be at most {LOAD_MAX:.0%} ({BLEND_MAX:.0%}): "
                f"{fewer if carried else ''}lower joint_service.rate_hz",
            )
