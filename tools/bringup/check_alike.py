"""Finds the board whose settings differ from the others', where the robot file has none. Pure.

Six boards are set up by hand, one after the other (pole pairs, brake resistor, encoder mode). A
forgotten or mistyped setting on one differs from the others, and nobody needs to know all of the
firmware's settings to find it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from statistics import median
from typing import Final

from shared.can.drive_settings import AXES, AXIS_TABLE, DRIVE_TABLE, describe_value
from tools.bringup.boards import Value
from tools.bringup.check_board import split_name
from tools.bringup.findings import Finding, ok, warning, wrong

Boards = Mapping[str, Mapping[str, Value]]
"""By module: a board's settings and readings."""

BOARDS_MIN: Final = 3
"""With fewer nobody knows which one is the odd one."""
MEASURED: Final = ("motor.config.phase_resistance", "motor.config.phase_inductance")
"""Calibration results; similar for motors of one kind."""
MEASURED_SHARE: Final = 0.3
"""Fraction of the median by which a value may differ: copper at 100 C has 30 % more than at 20
C."""
VOLTS_APART: Final = 1.0
"""Boards on one supply, at rest, and their tolerance."""

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
"""Below the axis: compared with the robot file, found by calibration, or written by services."""


def alike_rows(boards: Boards) -> list[Finding]:
    """Return the settings in which few boards differ from most, and values that no motor has."""
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
    """Return a row for each board that has a setting otherwise than more than half of them."""
    words = {module: describe_value(values.get(name)) for module, values in boards.items()}
    usual, count = Counter(words.values()).most_common(1)[0]
    if count == len(boards) or 2 * count <= len(boards):
        return []
    fix = "in `odrivetool`, and `save_configuration()`; or it is intended"
    wanted = f"{usual}, as {count} others"
    why = "a board with other settings behaves differently"
    return [
        warning(*split_name(module, name), found, wanted, fix, why)
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
    fix = "look at its three phase wires; calibrate it again (docs/bring-up.md, section 5)"
    for (module, axis), value in found.items():
        subject, words = f"{module}.{axis}", describe_value(value)
        if not value > 0.0:
            calibrated = boards[module].get(f"{axis}.motor.is_calibrated")
            if calibrated:
                why = "its current loop has no gains from it"
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
    fix = "its own fuse, plug and wires: the boards hang on one supply"
    return [
        warning(module, "supply", f"{value:.1f} V", f"about {usual:.1f} V, as the others", fix)
        for module, value in volts.items()
        if abs(value - usual) > VOLTS_APART
    ]
