"""Computes the load that drives put on a CAN bus at 1 Mbit/s (docs/drives.md). Pure.

A standard data frame with n bytes is 47 + 8n bits long, the gap after it included. After five
equal bits the sender stuffs one more; up to the end of the checksum, over 34 + 8n bits, that is
at most one in four, and `STUFFING` as measured on this robot's frames.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError

BITRATE: Final = 1_000_000
"""bit/s"""
LOAD_MAX: Final = 0.85
"""Share of a bus that may be planned with: requests, arming and errors come on top, and a full
bus delays a frame by as much as is queued before it. Torques for 12 axes at 333 Hz, with
heartbeats at 10 Hz, are 82 %."""
STUFFING: Final = 0.06
"""Stuff bits for each bit that can be stuffed: 0.05 while the robot stands."""
BLEND_MAX: Final = 0.98
"""Highest load of a bus while gains blend, for tenths of a second. Above it frames queue up, and
joints are controlled on old samples.
"""
GAINS_HZ: Final = 10.0
"""How often the onboard loop's gains go out even if they stand still."""
BLEND_HZ: Final = 125.0
"""And while they blend: `GAIN_UPDATE_MIN_MS` of `services.joint.drive_setpoint`."""
LOADCELL_FRAMES: Final = 3
"""To a sample of the harness sensor."""


class BusLoad(NamedTuple):
    """Traffic of the devices on a bus, bit/s."""

    cyclic: float
    """By each axis for each Hz of the control rate: estimate and target, bit."""
    steady: float
    """By each axis: heartbeat and gains, bit/s."""
    blend: float
    """By each axis while gains blend, on top, bit/s."""
    other: float
    """By the harness sensor, bit/s."""
    axes: int

    def share(self, rate_hz: float, *, blending: bool = False) -> float:
        """Return the load at a control rate, as a share of the bus."""
        steady = self.steady + self.blend * blending
        return (self.axes * (self.cyclic * rate_hz + steady) + self.other) / BITRATE

    def rate_max_hz(self) -> float:
        """Return the highest control rate that the bus carries, blends included; 0: none."""
        rates = (
            (most * BITRATE - self.other - self.axes * each) / (self.axes * self.cyclic)
            for most, each in self._limits()
        )
        return max(0.0, min(rates))

    def axes_max(self, rate_hz: float) -> int:
        """Return how many axes the bus carries at a control rate, blends included."""
        counts = (
            math.floor((most * BITRATE - self.other) / (self.cyclic * rate_hz + each))
            for most, each in self._limits()
        )
        return max(0, min(counts))

    def _limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return what share may be taken, and what each axis takes whatever the rate, bit/s."""
        return ((LOAD_MAX, self.steady), (BLEND_MAX, self.steady + self.blend))


def frame_bits(data_bytes: int) -> float:
    """Return the usual length of a standard data frame, bits."""
    return 47 + 8 * data_bytes + STUFFING * (34 + 8 * data_bytes)


def bus_load(
    axes: int, *, onboard: bool, heartbeat_period_ms: float, loadcell_rate_hz: float = 0.0
) -> BusLoad:
    """Return the load of a bus: per cycle, an estimate from each axis and a target to it.

    Onboard, targets of the motors' own loops take 8 bytes, and their gains; else torques take 4.
    `loadcell_rate_hz` are samples of a harness sensor on this bus.
    """
    full, half = frame_bits(8), frame_bits(4)
    gains = full + half if onboard else 0.0
    return BusLoad(
        cyclic=full + (full if onboard else half),
        steady=1e3 / heartbeat_period_ms * full + GAINS_HZ * gains,
        blend=(BLEND_HZ - GAINS_HZ) * gains,
        other=LOADCELL_FRAMES * loadcell_rate_hz * full,
        axes=axes,
    )


def check_buses(file: str, config: RobotConfig) -> None:
    """Refuse a bus that cannot carry the modules on it: ConfigError says what it can carry."""
    if config.joint_service.driver != "odrive_can":
        return
    modules: dict[str, int] = {}
    names: dict[str, str] = {}
    for module in config.module:
        channel = config.can[module.bus].channel
        modules[channel] = modules.get(channel, 0) + 1
        names.setdefault(channel, module.bus)
    service = config.joint_service
    sensor = config.can[config.harness.bus].channel
    for channel, count in modules.items():
        load = bus_load(
            2 * count,
            onboard=service.loop == "onboard",
            heartbeat_period_ms=config.drive.heartbeat_period_ms,
            loadcell_rate_hz=config.harness.rate_hz if channel == sensor else 0.0,
        )
        rate_hz = service.rate_hz
        carried, rate_max_hz = load.axes_max(rate_hz) // 2, load.rate_max_hz()
        if carried < count:
            raise ConfigError(
                file,
                f"can.{names[channel]}",
                f"{count} module{'s' if count > 1 else ''} at {rate_hz:g} Hz would load it to "
                f"{load.share(rate_hz):.0%} of 1 Mbit/s"
                f" ({load.share(rate_hz, blending=True):.0%} while gains blend)",
                f"at most {LOAD_MAX:.0%} ({BLEND_MAX:.0%}): {carried} "
                f"module{'s' if carried != 1 else ''} on a bus at this rate, or "
                f"joint_service.rate_hz of at most {math.floor(rate_max_hz)} Hz",
            )
