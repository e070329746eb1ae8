"""Differences between a board's settings and the wanted ones: found, shown, written, read back."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from rich import box
from rich.console import Group
from rich.padding import Padding
from rich.table import Column, Table
from rich.text import Text

from shared.can.cansimple import AxisState
from shared.can.drive_settings import AXES, WantedSetting, describe_value
from shared.exceptions import DriveError
from tools.bringup.boards import Board, Value, equal
from tools.bringup.check_board import CALIBRATE

_CALIBRATED = {"motor.config.pre_calibrated": "motor.is_calibrated",
               "encoder.config.pre_calibrated": "encoder.is_ready"}  # fmt: skip
"""Settings that a drive takes only once it is calibrated."""
_FOUND = (
    "encoder.config.direction",
    "encoder.config.phase_offset",
    "encoder.config.phase_offset_float",
)
"""Results of the encoder's calibration with the present wiring. With other values the motor has no
torque, or runs away.
"""


class SettingChange(NamedTuple):
    """One setting that is not as it should be."""

    module: str
    name: str
    before: Value
    after: Value
    """As it should be written."""
    why: str
    inhibit: str = ""
    """Why it cannot be written; "" if it can."""
    fits: Callable[[Value], bool] = bool
    """Whether a value that is read back is as it should be."""


class ChangeResult(NamedTuple):
    """What came of a change."""

    change: SettingChange
    now: Value
    """Read back after the restart."""
    good: bool


def changes_to_wanted(
    module: str, wanted: Iterable[WantedSetting], board: Board
) -> list[SettingChange]:
    """Return what of a board is not as the robot wants it."""
    settings = board.read(board.settings)
    calibrated = board.read([f"{axis}.{name}" for axis in AXES for name in _CALIBRATED.values()])
    changes = []
    for row in wanted:
        before = settings.get(row.name)
        if row.name not in settings:
            inhibit = "not there in this firmware; 0.5.6 has it"
        elif _fits(row, before):
            continue
        else:
            inhibit = _uncalibrated(row.name, calibrated)
        fits = partial(_fits, row)
        changes.append(SettingChange(module, row.name, before, row.value, row.why, inhibit, fits))
    return changes


def against_backup(module: str, saved: Mapping[str, Value], board: Board) -> list[SettingChange]:
    """Return what of a board is not as a backup has it."""
    settings = board.read(board.settings)
    changes = []
    for name, value in saved.items():
        if name not in settings:
            inhibit = "not there in this board's firmware"
        elif equal(settings[name], value):
            continue
        elif name.partition(".")[2] in _FOUND:
            inhibit = "calibration finds it from the wiring of the phases; the board keeps its own"
        else:
            inhibit = ""
        fits, before = partial(equal, value), settings.get(name)
        changes.append(SettingChange(module, name, before, value, "", inhibit=inhibit, fits=fits))
    return changes


def refuse_armed(module: str, board: Board) -> None:
    """Refuse a board one of whose axes is not idle: saving restarts it, and it lets go."""
    for axis, state in zip(AXES, board.states(), strict=True):
        if state != AxisState.IDLE:
            known = state in AxisState.__members__.values()
            words = AxisState(state).name if known else str(state)
            raise DriveError(
                f"{module}.{axis} is in {words}, not idle: saving restarts the board, and the "
                "module goes limp. Hang the robot; `xrl down`, or switch its supply off and on"
            )


def apply(board: Board, changes: Sequence[SettingChange]) -> list[ChangeResult]:
    """Write a board's changes, save them, and read them back after the restart."""
    to_write = sorted((change for change in changes if not change.inhibit), key=_watchdog_order)
    if to_write:
        board.write({change.name: change.after for change in to_write})
        board.save()
    now = board.read([change.name for change in changes])
    return [
        ChangeResult(
            change, now.get(change.name), change.name in now and change.fits(now[change.name])
        )
        for change in changes
    ]


def _watchdog_order(change: SettingChange) -> float:
    """Return a change's rank: a watchdog is off before its timeout changes, and on after that."""
    if not change.name.endswith(".config.enable_watchdog"):
        return 0.0
    return 1.0 if change.after else -1.0


def describe(value: Value) -> str:
    """Return a setting's value as a person would write it."""
    return "-" if value is None else describe_value(value)


def difference_table(difference: Sequence[SettingChange]) -> Group:
    """Return a difference for the terminal: a table, and below it why each is wanted."""
    one_line = [Column(heading, no_wrap=True) for heading in ("module", "setting")]
    rows = Table(
        *one_line, "now", "new", title="difference", title_justify="left", box=box.SIMPLE_HEAD
    )
    reasons: dict[str, None] = {}
    for change in difference:
        head, _, tail = change.name.rpartition(".")
        rows.add_row(
            change.module,
            f"{head}.\n{tail}" if head else tail,
            describe(change.before),
            describe(change.after),
        )
        if change.why:
            reasons.setdefault(f"{tail}: {change.why}")
        if change.inhibit:
            inhibit = f"{change.module} {change.name} cannot be written: {change.inhibit}"
            reasons.setdefault(inhibit)
    return Group(rows, *(Padding(Text(reason), (0, 0, 0, 2), expand=False) for reason in reasons))


def _fits(row: WantedSetting, value: Value) -> bool:
    return isinstance(value, bool | int | float) and row.fits(value)


def _uncalibrated(name: str, calibrated: Mapping[str, Value]) -> str:
    """Return why a setting cannot be written yet: the drive takes it only when calibrated."""
    axis, _, below = name.partition(".")
    status = _CALIBRATED.get(below)
    if status is None or calibrated.get(f"{axis}.{status}"):
        return ""
    return f"not calibrated: {CALIBRATE}"
