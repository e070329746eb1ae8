"""The difference between a board and what it should keep, closed; and backups of boards."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import pytest

from shared.can.cansimple import AxisState
from shared.can.drive_settings import of_module
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from tests.tools.bringup.board_in_memory import BoardInMemory, as_wanted
from tools.bringup.boards import (
    SettingChange,
    Value,
    against_backup,
    backup_of,
    changes_to_wanted,
    equal,
    read_backup,
    refuse_armed,
    settings_of,
    write_backup,
    write_changes,
)

MODULE = "knee_left"
VEL_LIMIT = "axis0.controller.config.vel_limit"
PERIOD = "axis1.config.can.encoder_rate_ms"
PRE_CALIBRATED = "axis1.encoder.config.pre_calibrated"


def difference(robot: RobotConfig, board: BoardInMemory) -> list[SettingChange]:
    return changes_to_wanted(MODULE, of_module(robot, MODULE), board)


def test_only_what_differs_is_written_saved_once_and_read_back(robot: RobotConfig) -> None:
    """Whichever way its currents count: calibration has found that."""
    left_alone = BoardInMemory(as_wanted() | {"axis0.encoder.config.direction": -1})
    assert difference(robot, left_alone) == []
    assert write_changes(left_alone, []) == []
    assert (left_alone.writes, left_alone.saves) == ([], 0)
    board = BoardInMemory(as_wanted() | {VEL_LIMIT: 2.0, PERIOD: 10, "config.other": 7})
    found = difference(robot, board)
    assert [(c.name, c.before, c.after) for c in found] == [(VEL_LIMIT, 2.0, 60.0), (PERIOD, 10, 2)]
    assert all(outcome.good for outcome in write_changes(board, found))
    assert board.writes == [VEL_LIMIT, PERIOD]
    assert board.saves == 1
    assert board.kept == as_wanted() | {"config.other": 7}


@pytest.mark.parametrize("restored", [False, True], ids=["wanted", "of a backup"])
@pytest.mark.parametrize(("on", "timeout"), [(True, 0.1), (False, 0.0)], ids=["on", "off"])
def test_a_watchdog_never_runs_with_a_timeout_that_is_not_its_own(
    robot: RobotConfig, on: bool, timeout: float, restored: bool
) -> None:
    """With 0 s it expires at once; the firmware's own order of the names is the wrong one."""
    drive = msgspec.structs.replace(robot.drive, watchdog_timeout=timeout)
    names = [f"axis0.config.{name}" for name in ("enable_watchdog", "watchdog_timeout")]
    wanted: dict[str, Value] = dict(zip(names, (on, timeout), strict=True))
    board = BoardInMemory(as_wanted() | dict(zip(names, (not on, 0.1 - timeout), strict=True)))
    with_it = msgspec.structs.replace(robot, drive=drive)
    found = against_backup(MODULE, wanted, board) if restored else difference(with_it, board)
    write_changes(board, found)
    order = names[::-1] if on else names
    assert [name for name in board.writes if name in names] == order
    assert board.kept.items() >= wanted.items()


def test_pre_calibrated_is_written_to_an_axis_only_once_it_is_calibrated(
    robot: RobotConfig,
) -> None:
    raw = BoardInMemory(as_wanted() | {PRE_CALIBRATED: False}, **{"axis1.encoder.is_ready": False})
    (change,) = difference(robot, raw)
    assert "--calibrate" in change.inhibit
    (outcome,) = write_changes(raw, [change])
    assert not outcome.good
    assert (raw.writes, raw.saves) == ([], 0)
    ready = BoardInMemory(as_wanted() | {PRE_CALIBRATED: False})
    assert write_changes(ready, difference(robot, ready))[0].good


def test_what_a_board_does_not_have_or_does_not_take_is_a_row_and_not_called_good(
    robot: RobotConfig,
) -> None:
    board = BoardInMemory({name: v for name, v in as_wanted().items() if name != PERIOD})
    (change,) = difference(robot, board)
    assert (change.before, change.name) == (None, PERIOD)
    assert "firmware" in change.inhibit
    assert not write_changes(board, [change])[0].good
    board = BoardInMemory(as_wanted() | {VEL_LIMIT: 2.0, PERIOD: 10})
    board.deaf = {PERIOD}
    outcomes = write_changes(board, difference(robot, board))
    assert [(o.change.name, o.good) for o in outcomes] == [(VEL_LIMIT, True), (PERIOD, False)]
    assert outcomes[1].now == 10


def test_a_backup_is_brought_back_to_the_last_setting() -> None:
    saved: dict[str, Value] = {"a.config.x": math.inf, "a.config.y": 3, "a.config.z": None}
    board = BoardInMemory({"a.config.x": 1.0, "a.config.y": 3, "a.config.z": "axis0.error"})
    found = against_backup(MODULE, saved, board)
    assert [change.name for change in found] == ["a.config.x", "a.config.z"]
    assert all(outcome.good for outcome in write_changes(board, found))
    assert board.kept == saved


def test_how_the_phases_were_wired_is_not_written_from_a_backup() -> None:
    """Wired otherwise since, and with the old offset, the motor would run away."""
    names = ("direction", "phase_offset", "phase_offset_float")
    found = {f"axis1.encoder.config.{name}": n + 0.5 for n, name in enumerate(names)}
    old = {name: -value for name, value in found.items()}
    board = BoardInMemory(found | {VEL_LIMIT: 2.0})
    outcomes = write_changes(board, against_backup(MODULE, old | {VEL_LIMIT: 60.0}, board))
    assert board.writes == [VEL_LIMIT]
    assert {o.change.name for o in outcomes if not o.good} == set(found), "and it is told"
    assert against_backup(MODULE, found, board) == []


@pytest.mark.parametrize("state", [AxisState.CLOSED_LOOP_CONTROL, AxisState.MOTOR_CALIBRATION, 99])
def test_a_board_with_an_axis_that_is_not_idle_is_refused(state: int) -> None:
    board = BoardInMemory({}, **{"axis1.current_state": int(state)})
    with pytest.raises(DriveError, match=r"knee_left\.axis1.*not idle"):
        refuse_armed(MODULE, board)
    refuse_armed(MODULE, BoardInMemory({}))


def test_a_backup_file_reads_back_as_it_was_written(tmp_path: Path) -> None:
    values = (math.inf, -math.inf, math.nan, True, 3, 0.25, None, "axis0.error")
    settings: dict[str, Value] = dict(zip("abcdefgh", values, strict=True))
    path = tmp_path / "new" / "b.json"
    board = backup_of(MODULE, BoardInMemory(settings))
    write_backup(path, [board], time="2026-03-01T10:15:00+0100", robot_file="robot.toml")
    read = read_backup(path)
    assert (read.robot_file, read.boards[0].serial_number) == ("robot.toml", "3A0000000005")
    again = settings_of(read.boards[0])
    assert again.keys() == settings.keys()
    assert all(equal(again[name], value) for name, value in settings.items())
    assert [type(value) for value in again.values()] == [type(v) for v in settings.values()]


@pytest.mark.parametrize(
    ("text", "says"),
    [("{", "not a backup"), ('{"time": 1}', "not a backup"), (None, "cannot be read")],
)
def test_a_file_that_is_no_backup_is_neither_read_nor_overwritten(
    tmp_path: Path, text: str | None, says: str
) -> None:
    path = tmp_path / "b.json"
    if text is not None:
        path.write_text(text, encoding="utf-8")
        with pytest.raises(DriveError, match="nothing was changed"):
            write_backup(path, [], time="", robot_file="")
        assert path.read_text(encoding="utf-8") == text
    with pytest.raises(DriveError, match=says):
        read_backup(path)
