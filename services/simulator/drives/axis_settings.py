"""Settings of the emulated drives by the firmware's names: a plain table {name: value}.

The defaults are those of firmware 0.5.6; this robot's values are in `shared.can.drive_settings`.
Each name has one column for all drives: the emulation reads its limits from the columns, and a
front reads and writes single values by name.

Source: the configuration structs of firmware 0.5.6 (odriverobotics/ODrive). The over-voltage
level is that of the 56 V board.

`encoder.config.direction` and `phase_offset` have no effect on the motion, as on a calibrated
drive; currents are reported with the sign of `direction`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from shared.can import drive_settings
from shared.can.drive_settings import Need, Value
from shared.config.sections import DriveConfig
from shared.exceptions import DriveError
from shared.joints import MODULES, N_JOINTS

__all__ = [
    "AXIS_SETTINGS", "DIRECTION", "DRIVE_SETTINGS", "NAMES", "N_DRIVES", "PHASE_INDUCTANCE",
    "PHASE_RESISTANCE", "POLE_PAIRS", "Settings", "Value", "configured",
]  # fmt: skip

Vector = NDArray[np.float64]

N_DRIVES: Final = len(MODULES)

AXIS_SETTINGS: Final[Mapping[str, Value]] = {
    "config.enable_watchdog": False,
    "config.watchdog_timeout": 0.0,
    "config.startup_motor_calibration": False,
    "config.startup_encoder_offset_calibration": False,
    "config.startup_closed_loop_control": False,
    "config.can.node_id": 0,
    "config.can.heartbeat_rate_ms": 100,
    "config.can.encoder_rate_ms": 10,
    "controller.config.control_mode": 3,
    "controller.config.input_mode": 1,
    "controller.config.pos_gain": 20.0,
    "controller.config.vel_gain": 1.0 / 6.0,
    "controller.config.vel_integrator_gain": 1.0 / 3.0,
    "controller.config.vel_integrator_limit": math.inf,
    "controller.config.vel_limit": 2.0,
    "controller.config.vel_limit_tolerance": 1.2,
    "controller.config.enable_vel_limit": True,
    "controller.config.enable_overspeed_error": True,
    "controller.config.enable_torque_mode_vel_limit": True,
    "controller.config.spinout_electrical_power_threshold": 10.0,
    "controller.config.spinout_mechanical_power_threshold": -10.0,
    "motor.config.pre_calibrated": False,
    "motor.config.pole_pairs": 7,
    "motor.config.calibration_current": 10.0,
    "motor.config.resistance_calib_max_voltage": 2.0,
    "motor.config.torque_constant": 0.04,
    "motor.config.current_lim": 10.0,
    "motor.config.current_lim_margin": 8.0,
    "motor.config.current_control_bandwidth": 1000.0,
    "motor.config.phase_resistance": 0.0,
    "motor.config.phase_inductance": 0.0,
    "motor.fet_thermistor.config.enabled": True,
    "motor.fet_thermistor.config.temp_limit_lower": 100.0,
    "motor.fet_thermistor.config.temp_limit_upper": 120.0,
    "motor.motor_thermistor.config.enabled": False,
    "motor.motor_thermistor.config.temp_limit_lower": 100.0,
    "motor.motor_thermistor.config.temp_limit_upper": 120.0,
    "encoder.config.mode": 0,
    "encoder.config.cpr": 8192,
    "encoder.config.bandwidth": 1000.0,
    "encoder.config.direction": 0,
    "encoder.config.phase_offset": 0,
    "encoder.config.calib_range": 0.02,
    "encoder.config.calib_scan_distance": 16.0 * math.pi,
    "encoder.config.calib_scan_omega": 4.0 * math.pi,
    "encoder.config.pre_calibrated": False,
}
"""Settings of each axis, below `axis0.` and `axis1.`; the defaults have the settings' types."""

DRIVE_SETTINGS: Final[Mapping[str, Value]] = {
    "config.dc_bus_undervoltage_trip_level": 8.0,
    "config.dc_bus_overvoltage_trip_level": 59.92,
    "config.dc_max_positive_current": math.inf,
    "config.dc_max_negative_current": -0.01,
    "config.max_regen_current": 0.0,
    "config.enable_brake_resistor": False,
    "config.brake_resistance": 2.0,
    "can.config.baud_rate": 250_000,
}
"""Settings of the whole ODrive."""

NAMES: Final = (
    *DRIVE_SETTINGS,
    *(f"axis{axis}.{name}" for axis in (0, 1) for name in AXIS_SETTINGS),
)
"""Every setting of one ODrive."""

PHASE_RESISTANCE: Final = 0.1
"""Phase resistance, ohm; assumed for a motor with this torque constant. Calibration measures it."""
PHASE_INDUCTANCE: Final = 5e-5
"""Phase inductance, H; assumed for the same motor. Calibration measures it."""
POLE_PAIRS: Final = 7
"""True pole pairs of the motors, which a drive's setting does not change; assumed."""
ENCODER_MODE: Final = 257
"""Absolute over SPI, AMS; set by hand before any calibration."""
CALIBRATION_CURRENT: Final = 15.0
"""A; also set by hand, because the default of 10 A does not turn a knee that hangs on its stop."""
DIRECTION: Final = 1
"""+1 or -1, from the wiring of a motor's phases. Calibration detects it."""


class Settings:
    """The settings of all drives.

    Attributes:
        version: number of changes made by name. Code that caches a column compares it to detect a
            change.
    """

    def __init__(self) -> None:
        """Start with ODrive's defaults."""
        self.version = 0
        self._axes = {name: np.full(N_JOINTS, float(v)) for name, v in AXIS_SETTINGS.items()}
        self._drives = {name: np.full(N_DRIVES, float(v)) for name, v in DRIVE_SETTINGS.items()}
        self._saved: list[dict[str, Value]] = [self.table(drive) for drive in range(N_DRIVES)]

    def axis(self, name: str) -> Vector:
        """Return an axis setting's column (12,): a view that may be read at any time."""
        return self._axes[name]

    def drive(self, name: str) -> Vector:
        """Return a drive setting's column (6,): a view that may be read at any time."""
        return self._drives[name]

    def fill(self, name: str, value: Value) -> None:
        """Set a value on all drives, or on all axes; `name` as in the two tables."""
        column = self._axes.get(name)
        (self._drives[name] if column is None else column)[:] = value
        self.version += 1

    def get(self, drive: int, name: str) -> Value:
        """Return a setting of a drive (0 .. 5) by its name in `NAMES`, in its own type."""
        column, row, default = self._find(drive, name)
        value = column[row]
        return type(default)(value)

    def set(self, drive: int, name: str, value: Value) -> None:
        """Set a setting of a drive by its name in `NAMES`.

        Raises:
            DriveError: the setting is unknown, or the value is not of its type.
        """
        column, row, default = self._find(drive, name)
        number = float(value)
        whole = isinstance(default, int)
        if math.isnan(number) or (whole and not number.is_integer()):
            raise DriveError(f"{name} = {value!r}: not a valid {type(default).__name__}")
        column[row] = bool(value) if isinstance(default, bool) else number
        self.version += 1

    def find(self, axis: int, name: str, value: float) -> None:
        """Set the value that a calibration of an axis (0 .. 11) found; NaN if it found none."""
        self._axes[name][axis] = value
        self.version += 1

    def current(self, axis: int, torque: float) -> float:
        """Return the current that an axis (0 .. 11) reports for a motor torque, A.

        The firmware reverses the torque where the encoder's calibration found reversed phases
        (Motor::update), so the current has that sign.
        """
        amperes = float(torque / self._axes["motor.config.torque_constant"][axis])
        return -amperes if self._axes["encoder.config.direction"][axis] < 0.0 else amperes

    def table(self, drive: int) -> dict[str, Value]:
        """Return every setting of a drive by name."""
        return {name: self.get(drive, name) for name in NAMES}

    def save(self, drive: int) -> None:
        """Save a drive's settings for a restart, as `save_configuration` does."""
        self._saved[drive] = self.table(drive)

    def restore(self, drive: int) -> None:
        """Restore a drive's saved settings, as a restart does."""
        for name, value in self._saved[drive].items():
            column, row, _ = self._find(drive, name)
            column[row] = value  # even a NaN
        self.version += 1

    def _find(self, drive: int, name: str) -> tuple[Vector, int, Value]:
        """Return the column, the row in it, and the default of a setting."""
        head, _, rest = name.partition(".")
        if name in DRIVE_SETTINGS:
            return self._drives[name], drive, DRIVE_SETTINGS[name]
        if head in ("axis0", "axis1") and rest in AXIS_SETTINGS:
            return self._axes[rest], 2 * drive + int(head[-1]), AXIS_SETTINGS[rest]
        near = difflib.get_close_matches(name, NAMES, n=1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise DriveError(f"unknown setting {name!r}{hint}")


def configured(
    drive: DriveConfig, *, encoder_counts_per_turn: int, watchdog: bool = True
) -> Settings:
    """Return the settings that the services rely on, saved on every drive.

    Without `watchdog` the drives' watchdogs do not run.
    """
    settings = Settings()
    need = Need(drive, encoder_counts_per_turn, watchdog)
    for name, value in drive_settings.of_every_drive(need).items():
        settings.fill(name, value)
    settings.fill("motor.config.phase_resistance", PHASE_RESISTANCE)
    settings.fill("motor.config.phase_inductance", PHASE_INDUCTANCE)
    settings.fill("encoder.config.direction", DIRECTION)
    settings.fill("encoder.config.mode", ENCODER_MODE)
    settings.fill("motor.config.calibration_current", CALIBRATION_CURRENT)
    for index in range(N_DRIVES):
        settings.save(index)
    return settings
