"""Check the settings and state of each ODrive, and compare all ODrives. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from enum import IntFlag
from statistics import median
from typing import Final

from services.joint.differential import joint_from_motor
from shared.can.cansimple import AxisError, AxisState, OdriveError
from shared.can.drive_settings import AXES, AXIS_TABLE, DRIVE_TABLE, WantedSetting, describe_value
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import AXES as JOINT_AXES
from shared.joints import MODULE_INDEX
from tools.bringup.boards import (
    AXIS_ERRORS,
    CALIBRATE,
    DIRECTION,
    FIRMWARE,
    Value,
    describe_firmware,
    is_known,
    number,
)
from tools.bringup.findings import Finding, advised, judged, ok, warning, wrong

Values = Mapping[str, Value]

OVERVOLTAGE_SHARE: Final = 0.95
"""Maximum supply voltage, as a fraction of the trip level: braking legs raise the voltage."""

TEMPERATURES: Final = (-10.0, 70.0)
"""Valid temperatures of an idle output stage, C."""

FIND_CAUSE: Final = "find the cause; arming (`xrl up`) or a power cycle clears the error"

Boards = Mapping[str, Mapping[str, Value]]
"""Settings and readings of each board, by module."""

BOARDS_MIN: Final = 3
"""Minimum number of boards to compare: with fewer, it is unclear which one differs."""
MEASURED: Final = ("motor.config.phase_resistance", "motor.config.phase_inductance")
"""Calibration results, which are similar for motors of one kind."""
MEASURED_SHARE: Final = 0.3
"""Maximum relative deviation from the median: copper has 30 % more resistance at 100 C than
at 20 C."""
VOLTS_APART: Final = 1.0
"""Maximum deviation from the median voltage of boards on one supply, at rest, V."""

_OWN: Final = frozenset(
    {setting.name for setting in (*AXIS_TABLE, *DRIVE_TABLE)}
    | {
        *MEASURED,
        *("controller.config.control_mode", "controller.config.pos_gain"),
        "controller.config.vel_gain",
        *("encoder.config.phase_offset", "encoder.config.phase_offset_float"),
        *("encoder.config.direction", "encoder.config.index_offset"),
        *("encoder.config.hall_polarity", "encoder.config.hall_polarity_calibrated"),
        *("controller.config.anticogging.index", "motor.config.direction"),
    }
)
"""Settings, without their axis, that are not compared between boards. They are compared with the
robot file, found by calibration, or written by services."""


def firmware_row(module: str, firmware: tuple[int, int, int]) -> Finding:
    """Judge a board's firmware."""
    wanted = describe_firmware(FIRMWARE)
    found = describe_firmware(firmware)
    fix = (
        f"flash {wanted}: `odrivetool legacy-dfu FILE.elf`; then "
        f"`xrl drive configure --apply --module {module}`"
    )
    if is_known(firmware):
        why = "settings may have other names or defaults"
        return advised(firmware == FIRMWARE, module, "firmware", found, wanted, fix, why)
    why = "settings, errors and CAN frames differ, so nothing can be compared"
    return wrong(module, "firmware", found, wanted, fix, why)


def settings_rows(module: str, wanted: tuple[WantedSetting, ...], values: Values) -> list[Finding]:
    """Compare a board's settings with the wanted ones; all that match share one row."""
    rows = []
    fix = f"`xrl drive configure --apply --module {module}`"
    for setting in wanted:
        subject, name = _split_name(module, setting.name)
        value = values.get(setting.name)
        words = setting.describe()
        if not isinstance(value, bool | int | float):
            rows.append(
                warning(subject, name, "missing", words, "flash firmware 0.5.6", setting.why)
            )
        elif not setting.fits(value):
            by_hand = CALIBRATE if name.endswith("pre_calibrated") else fix
            rows.append(wrong(subject, name, describe_value(value), words, by_hand, setting.why))
    fitting = f"{len(wanted) - len(rows)} as wanted"
    return [ok(module, "other settings" if rows else "settings", fitting), *rows]


def direction_rows(module: str, values: Values, robot: RobotConfig) -> list[Finding]:
    """Judge the direction that the encoder calibration of each axis found.

    If the direction is -1, the firmware inverts the torque: the motion is correct, but the reported
    currents have the opposite sign. Over USB, direction and currents can be read; over CAN with
    firmware 0.5, only the currents. An uncalibrated axis has no direction, and therefore no row.
    """
    over_can = robot.joint_service.driver == "odrive_can"
    fix = (
        "swap two of the motor's phases and calibrate again; `motor_signs` is only for mirrored "
        "legs"
    )
    why = "CAN does not report it: a service that takes over the drive would reverse the torque"
    rows = []
    for axis in AXES:
        value = values.get(f"{axis}.{DIRECTION}")
        if isinstance(value, int | float) and values.get(f"{axis}.encoder.is_ready"):
            wanted = "1" if over_can else "1 or -1"
            subject, found = f"{module}.{axis}", describe_value(value)
            good = value == 1 or (not over_can and value == -1)
            by_hand = fix if value == -1 else CALIBRATE
            rows.append(judged(good, subject, DIRECTION, found, wanted, by_hand, why))
    return rows


def error_rows(module: str, values: Values) -> list[Finding]:
    """Return a row for each error of a board, or one ok row if there is none.

    An expired watchdog is no fault: no service fed it, and arming clears the error.
    """
    rows = []
    if error := int(number(values, "error")):
        found = describe_flags(OdriveError, error)
        rows.append(wrong(module, "error", found, "none", FIND_CAUSE, "both axes disarm"))
    for axis in AXES:
        for name, kind in AXIS_ERRORS.items():
            bits = int(number(values, f"{axis}.{name}"))
            benign = kind is AxisError and bits == AxisError.WATCHDOG_TIMER_EXPIRED
            if bits and not benign:
                found = describe_flags(kind, bits)
                rows.append(wrong(f"{module}.{axis}", name, found, "none", FIND_CAUSE))
    return rows or [ok(module, "errors", "none", "none")]


def condition_rows(
    module: str, values: Values, trip_levels: tuple[float, float], *, services_up: bool
) -> list[Finding]:
    """Judge supply, brake resistor, temperature, calibration and state from a board's values."""
    rows = [_voltage(module, number(values, "vbus_voltage"), trip_levels)]
    if values.get("config.enable_brake_resistor") and "brake_resistor_armed" in values:
        armed = bool(values["brake_resistor_armed"])
        fix = "check `brake_resistance` and the resistor's wires; cycle the power"
        why = "neither axis arms without it"
        found = "armed" if armed else "not armed"
        rows.append(judged(armed, module, "brake resistor", found, "armed", fix, why))
    for axis in AXES:
        subject = f"{module}.{axis}"
        celsius = values.get(f"{axis}.motor.fet_thermistor.temperature")
        if isinstance(celsius, int | float):
            rows.append(_temperature(subject, celsius))
        lacking = [
            part
            for part, name in (("motor", "motor.is_calibrated"), ("encoder", "encoder.is_ready"))
            if not values.get(f"{axis}.{name}")
        ]
        found, why = f"{' and '.join(lacking)} not" if lacking else "yes", "the axis cannot arm"
        rows.append(judged(not lacking, subject, "calibrated", found, "yes", CALIBRATE, why))
        state = int(number(values, f"{axis}.current_state"))
        rows.append(state_row(subject, state, services_up=services_up))
    return rows


def state_row(subject: str, state: int, *, services_up: bool) -> Finding:
    """Judge an axis's state: idle, or in closed loop if a joint service holds it."""
    known = state in AxisState.__members__.values()
    found = AxisState(state).name.lower().replace("_", " ") if known else str(state)
    if state == AxisState.IDLE:
        return ok(subject, "state", found, "idle")
    if state == AxisState.CLOSED_LOOP_CONTROL and services_up:
        return ok(subject, "state", found, "armed by its service")
    fix = "hang the robot; `xrl up` takes over the drive, and power off releases it"
    return warning(subject, "state", found, "idle", fix, "it moves or holds without a service")


def position_rows(module: str, turns: tuple[float, float], robot: RobotConfig) -> list[Finding]:
    """Judge the position of a module's joint from the positions that its drive counts."""
    mark, again = robot.drive.zero_mark_turns, f"`xrl drive zero {module} --at PHI,THETA`"
    a, b = turns[0] - mark, turns[1] - mark
    if mark > 0.0 and max(abs(a), abs(b)) > 0.5 * mark:
        found = f"motors at {turns[0]:.1f}, {turns[1]:.1f} turns"
        why = "the drive lost its zero with its power, and cannot be armed without a zero"
        return [wrong(module, "zero", found, f"about {mark:g}", again, why)]
    q = joint_from_motor((a, b), robot.joint.gear_ratio)
    rows = [ok(module, "zero", "known", "known")]
    limits = robot.joint_limits()[2 * MODULE_INDEX[module] :][:2]
    fix = f"move it inside by hand; if it is already inside, run {again}"
    why = "a joint outside its limits cannot be armed"
    for name, angle, (low, high) in zip(JOINT_AXES, q, limits, strict=True):
        inside, found, wanted = low <= angle <= high, f"{angle:.2f} rad", f"{low:g} to {high:g}"
        rows.append(judged(inside, f"{module}.{name}", "angle", found, wanted, fix, why))
    return rows


def describe_flags(kind: type[IntFlag], bits: int) -> str:
    """Return the names of an error register's bits, and unknown bits in hex."""
    names = [flag.name or "" for flag in kind if flag and bits & flag == flag]
    rest = bits & ~sum(flag for flag in kind if flag)
    return " ".join([*names, *([hex(rest)] if rest else [])])


def _temperature(subject: str, celsius: float) -> Finding:
    low, high = TEMPERATURES
    fix = "let the board cool; if the reading stays, the thermistor is broken: replace the board"
    why = "from 100 C on the drive reduces its current, and at 125 C it disarms"
    good, found = low <= celsius <= high, f"{celsius:.0f} C"  # NaN is not good
    return advised(good, subject, "temperature", found, f"{low:g} to {high:g} C", fix, why)


def _voltage(module: str, volts: float, trip_levels: tuple[float, float]) -> Finding:
    low, high = trip_levels
    wanted = f"{low:g} to {high:g} V"
    found = f"{volts:.1f} V"
    if volts <= low:
        return wrong(module, "supply", found, wanted, "switch the supply on, and check its fuse")
    if volts >= high:
        return wrong(module, "supply", found, wanted, "lower the voltage, or use another board")
    if volts > OVERVOLTAGE_SHARE * high:
        fix = "use a lower supply voltage: braking legs raise it"
        return warning(module, "supply", found, f"< {OVERVOLTAGE_SHARE * high:.1f} V", fix)
    return ok(module, "supply", found, wanted)


def trip_levels_of(values: Values) -> tuple[float, float]:
    """Return a board's under- and overvoltage trip levels, V; DriveError if they are swapped."""
    low, high = (
        number(values, f"config.dc_bus_{name}voltage_trip_level") for name in ("under", "over")
    )
    if low >= high:
        raise DriveError(
            f"its undervoltage trip level is {low:g} V; must be below the overvoltage trip level, "
            f"{high:g} V"
        )
    return low, high


def _split_name(module: str, name: str) -> tuple[str, str]:
    """Return the subject, such as "knee_left.axis0", and the setting's name without its axis."""
    axis, _, rest = name.partition(".")
    return (f"{module}.{axis}", rest) if axis in AXES else (module, name)


def alike_rows(boards: Boards) -> list[Finding]:
    """Compare boards: settings in which a few boards differ, motor data, and supply voltages."""
    if len(boards) < BOARDS_MIN:
        return []
    names = dict.fromkeys(name for values in boards.values() for name in values)
    rows = [row for name in names if _is_shared(name) for row in _odd_ones(name, boards)]
    rows += [row for name in MEASURED for row in _measured_rows(name, boards)]
    rows += _supply_rows(boards)
    return rows or [ok(f"all {len(boards)}", "against each other", "alike", "alike")]


def _is_shared(name: str) -> bool:
    axis, _, below = name.partition(".")
    return ".config." in f".{name}" and (below if axis in AXES else name) not in _OWN


def _odd_ones(name: str, boards: Boards) -> list[Finding]:
    """Return a row for each board whose setting differs from the value of most boards."""
    words = {module: describe_value(values.get(name)) for module, values in boards.items()}
    usual, count = Counter(words.values()).most_common(1)[0]
    if count == len(boards) or 2 * count <= len(boards):
        return []
    fix = "unless this is intended, set it in `odrivetool` and call `save_configuration()`"
    wanted = f"{usual}, as {count} others"
    why = "the module may behave differently from the others"
    return [
        warning(*_split_name(module, name), found, wanted, fix, why)
        for module, found in words.items()
        if found != usual
    ]


def _measured_rows(name: str, boards: Boards) -> list[Finding]:
    found = {
        (module, axis): float(value)
        for module, values in boards.items()
        for axis in AXES
        if isinstance(value := values.get(f"{axis}.{name}"), int | float)
    }
    if not found:
        return []
    usual = median(found.values())
    rows = []
    fix = "check the three phase wires and calibrate again (docs/bring-up.md, section 5)"
    for (module, axis), value in found.items():
        subject, words = f"{module}.{axis}", describe_value(value)
        if not value > 0.0:
            calibrated = boards[module].get(f"{axis}.motor.is_calibrated")
            if calibrated:
                why = "the gains of the current loop cannot be computed"
                rows.append(wrong(subject, name, words, "> 0", fix, why))
        elif abs(value - usual) > MEASURED_SHARE * usual:
            why = "a loose or broken phase, or another motor"
            rows.append(warning(subject, name, words, f"about {usual:.3g}", fix, why))
    return rows


def _supply_rows(boards: Boards) -> list[Finding]:
    volts = {
        module: float(value)
        for module, values in boards.items()
        if isinstance(value := values.get("vbus_voltage"), int | float)
    }
    usual = median(volts.values()) if volts else 0.0
    fix = "check this board's fuse, plug and wires: all boards share one supply"
    return [
        warning(module, "supply", f"{value:.1f} V", f"about {usual:.1f} V, like the others", fix)
        for module, value in volts.items()
        if abs(value - usual) > VOLTS_APART
    ]
