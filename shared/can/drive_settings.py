"""Settings that this robot needs on its ODrives: one table, with the names of firmware 0.5.6.

With factory settings an ODrive disarms, limits or answers in ways that make this robot fall
(docs/drives.md#traps). The simulator configures its drives from this table, `xrl doctor` compares a
drive with it, and `xrl drive configure` writes it, so the three cannot disagree.

The joint services write some modes, gains and limits at arming or in every cycle. The table also
contains those of them that a drive needs when another program arms it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from typing import TYPE_CHECKING, Final, NamedTuple

from shared.can.cansimple import InputMode
from shared.config.sections import DriveConfig

if TYPE_CHECKING:
    from shared.config.robot_config import RobotConfig

Value = bool | int | float

AXES: Final = ("axis0", "axis1")
"""Both axes of an ODrive, as its settings name them; axis0 is the first of `node_ids`."""

CAN_BAUD_RATE: Final = 1_000_000
OVERVOLTAGE_MAX: Final = 59.92
"""V; the firmware's default on a 56 V board. Above it nothing protects the output stage."""
OVERSPEED_TOLERANCE: Final = 1.2
"""The firmware's default; closer to 1, a noisy estimate at vel_limit would disarm a drive."""
SPINOUT_POWER: Final = 100.0
"""W; 10 by default. A drive assumes a slipped encoder, and disarms, if its motor brakes with more
than this and draws more than this beyond the copper loss at its calibrated resistance. A winding at
100 C has 30 % more resistance: 40 W more at 30 A and 0.1 ohm, 72 W at 40 A."""

_RELATIVE: Final = 1e-6
"""Relative tolerance: a drive stores single floats."""


class Compare(Enum):
    """Comparison of a setting with its wanted value."""

    EQUAL = ""
    AT_LEAST = ">= "
    AT_MOST = "<= "


class Need(NamedTuple):
    """Parameters of the wanted values."""

    drive: DriveConfig
    encoder_counts_per_turn: int
    watchdog: bool = True
    """True if the drives' watchdogs must run, provided that the robot file gives a timeout."""
    node_id: int | None = None
    """CAN node of the axis; None: unknown here, and not checked."""


class _Setting(NamedTuple):
    """One row of the table."""

    name: str
    """Name below `axis0.` and `axis1.`, or of the whole drive."""
    wanted: Callable[[Need], Value | None]
    """Wanted value; None: any."""
    why: str
    """Reason for the value, mostly the consequence of any other."""
    compare: Compare = Compare.EQUAL


class WantedSetting(NamedTuple):
    """A setting of one drive, with its full name and its computed value."""

    name: str
    value: Value
    why: str
    compare: Compare

    def fits(self, found: Value) -> bool:
        """Return True if a value found on a drive fits this setting."""
        if self.compare is not Compare.EQUAL and not math.isnan(found):
            beyond = found > self.value if self.compare is Compare.AT_LEAST else found < self.value
            return beyond or same(found, self.value)
        return same(found, self.value)

    def describe(self) -> str:
        """Return the wanted value as text: "60", ">= 1.2"."""
        return f"{self.compare.value}{describe_value(self.value)}"


AXIS_TABLE: Final[tuple[_Setting, ...]] = (
    _Setting("config.watchdog_timeout", lambda need: need.drive.watchdog_timeout,
        "a drive that receives nothing disarms after this; if too short, a delay disarms it"),
    _Setting("config.enable_watchdog",
        lambda need: need.watchdog and need.drive.watchdog_timeout > 0.0,
        "if it fires, the module goes limp: off with the onboard loop, else on"),
    _Setting("config.startup_motor_calibration", lambda _: False,
        "the motor would move on its own at power-up"),
    _Setting("config.startup_encoder_offset_calibration", lambda _: False,
        "the motor would turn on its own at power-up"),
    _Setting("config.startup_closed_loop_control", lambda _: False,
        "the axis would arm on its own at power-up, before a service controls it"),
    _Setting("config.can.node_id", lambda need: need.node_id,
        "the services would address another axis, or none"),
    _Setting("config.can.heartbeat_rate_ms", lambda need: need.drive.heartbeat_period_ms,
        "only the next heartbeat shows that an axis has disarmed"),
    _Setting("config.can.encoder_rate_ms", lambda need: need.drive.encoder_period_ms,
        "encoder frames clock the joint service; the factory setting is 100 Hz"),
    _Setting("controller.config.input_mode", lambda _: int(InputMode.PASSTHROUGH),
        "any other mode filters or ignores the targets"),
    _Setting("controller.config.vel_integrator_gain", lambda _: 0.0,
        "an integrator winds up under the robot's weight; the law uses none in the drive"),
    _Setting("controller.config.vel_limit", lambda need: need.drive.vel_limit,
        "a speed above this times vel_limit_tolerance disarms with OVERSPEED, in torque mode too"),
    _Setting("controller.config.vel_limit_tolerance", lambda _: OVERSPEED_TOLERANCE,
        "OVERSPEED would fire close to vel_limit", Compare.AT_LEAST),
    _Setting("controller.config.enable_overspeed_error", lambda _: True,
        "a runaway motor would not be stopped"),
    _Setting("controller.config.enable_torque_mode_vel_limit", lambda _: False,
        "in torque mode vel_gain would limit the torque; at vel_gain = 0, to zero"),
    _Setting("controller.config.spinout_electrical_power_threshold", lambda _: SPINOUT_POWER,
        "an axis that sinks under load with a warm winding disarms (SPINOUT_DETECTED)",
        Compare.AT_LEAST),
    _Setting("controller.config.spinout_mechanical_power_threshold", lambda _: -SPINOUT_POWER,
        "an axis that sinks under load with a warm winding disarms (SPINOUT_DETECTED)",
        Compare.AT_MOST),
    _Setting("motor.config.pre_calibrated", lambda _: True,
        "the motor would have to be calibrated after each power-up before it arms"),
    _Setting("motor.config.torque_constant", lambda need: need.drive.torque_constant,
        "every torque would be wrong by the ratio"),
    _Setting("motor.config.current_lim", lambda need: need.drive.current_lim,
        "less (factory: 10 A) cannot carry the robot; more is not covered by the file's checks"),
    _Setting("motor.fet_thermistor.config.enabled", lambda _: True,
        "the output stage would not protect itself"),
    _Setting("encoder.config.cpr", lambda need: need.encoder_counts_per_turn,
        "every angle would be wrong by the ratio"),
    _Setting("encoder.config.bandwidth", lambda need: need.drive.encoder_bandwidth,
        "if lower, the drive's damping lags and shakes the rotors; if higher, it is noisy"),
    _Setting("encoder.config.pre_calibrated", lambda _: True,
        "the motor would have to turn on its own after each power-up before it arms"),
)  # fmt: skip
"""Settings of each axis, in the order in which they are written: a watchdog that is enabled before
its timeout is set expires at once."""

DRIVE_TABLE: Final[tuple[_Setting, ...]] = (
    _Setting("config.dc_max_negative_current", lambda need: need.drive.dc_max_negative_current,
        "braking legs feed current back; the factory setting, -0.01 A, trips both axes at once"),
    _Setting("config.dc_bus_overvoltage_trip_level", lambda _: OVERVOLTAGE_MAX,
        "the current that braking legs feed back could destroy the output stage", Compare.AT_MOST),
    _Setting("can.config.baud_rate", lambda _: CAN_BAUD_RATE,
        "the bus carries two axes at the joint services' rate only at 1 Mbit/s"),
)  # fmt: skip
"""Settings of the whole ODrive."""


def of_module(robot: RobotConfig, module: str) -> tuple[WantedSetting, ...]:
    """Return all wanted settings of a module's ODrive."""
    counts = robot.joint.encoder_counts_per_turn
    common = Need(robot.drive, counts)
    rows = [_worked_out(setting, common, "") for setting in DRIVE_TABLE]
    for axis, node_id in zip(AXES, robot.module_named(module).node_ids, strict=True):
        need = Need(robot.drive, counts, node_id=node_id)
        rows += [_worked_out(setting, need, f"{axis}.") for setting in AXIS_TABLE]
    return tuple(row for row in rows if row is not None)


def of_every_drive(need: Need) -> dict[str, Value]:
    """Return the settings that all drives share, by the tables' names."""
    values = {setting.name: setting.wanted(need) for setting in (*DRIVE_TABLE, *AXIS_TABLE)}
    return {name: value for name, value in values.items() if value is not None}


def same(one: Value, other: Value) -> bool:
    """Return True if two values are the same to a drive, which stores single floats."""
    if isinstance(one, float) or isinstance(other, float):
        both_nan = math.isnan(one) and math.isnan(other)
        return both_nan or math.isclose(one, other, rel_tol=_RELATIVE)
    return one == other


def describe_value(value: object) -> str:
    """Return a setting's value as a person would write it."""
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _worked_out(setting: _Setting, need: Need, prefix: str) -> WantedSetting | None:
    value = setting.wanted(need)
    if value is None:
        return None
    return WantedSetting(f"{prefix}{setting.name}", value, setting.why, setting.compare)
