"""`xrl drive configure` on emulated drives, from the command line to what the drives keep."""

from __future__ import annotations

import dataclasses
import os
import signal
import socket
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

from shared.can.drive_settings import of_module
from shared.config.robot_config import RobotConfig, expand
from shared.exceptions import DriveError, FleetError
from shared.joints import MODULES
from shared.run_directory import make_live_dir
from tests.system.fleets import xrl
from tests.tools.bringup.board_in_memory import BoardInMemory, as_wanted
from tests.tools.exit_codes import exit_code
from tools.bringup import drive_access
from tools.bringup.boards import (
    Backup,
    BoardBackup,
    FoundBoards,
    Value,
    changes_to_wanted,
    read_backup,
    settings_of,
    write_backup,
)
from tools.bringup.motion_runner import Interrupts
from tools.fleet import procfs
from tools.fleet.run_dir import RunDir
from tools.terminal import Console
from tools.verbs.drive import configure

VEL_LIMIT = "axis0.controller.config.vel_limit"
MODULE = "knee_left"
SERIAL = "3A0000000005"


@contextmanager
def listening(path: Path) -> Iterator[None]:
    """Listen where a service would."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        yield
    path.unlink()


@pytest.fixture
def run_dir() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="xrl-t-") as folder:
        path = Path(folder) / "r"
        yield path
        assert procfs.fleet_pids(path) == set(), "no process is left"


@pytest.mark.parametrize(
    ("limit", "apply", "code", "words"),
    [
        (2.0, [], 3, ("vel_limit", "OVERSPEED", "nothing was written")),
        (60.0, ["--apply"], 0, ("nothing to change",)),
    ],
    ids=["shown only", "as wanted"],
)
def test_what_is_only_shown_or_as_wanted_is_not_written(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch, limit: float, apply: list[str], code: int,
    words: tuple[str, ...],
) -> None:  # fmt: skip
    board = BoardInMemory(as_wanted() | {VEL_LIMIT: limit})
    found = FoundBoards({SERIAL: board}, {}, ())
    monkeypatch.setattr(configure, "drives_within_reach", lambda *_, **__: nullcontext(False))
    monkeypatch.setattr(configure, "boards_on_usb", lambda *_: nullcontext(found))
    place = ["--module", MODULE, "--out", tmp_path / "b", "--run-dir", run_dir]
    assert exit_code(["drive", "configure", *place, *apply]) == code
    told = capsys.readouterr().out
    assert all(word in told for word in words)
    assert not (tmp_path / "b").exists()
    assert (board.writes, board.saves) == ([], 0)


def verb(run_dir: Path, out: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    words = ("drive", "configure", "--out", out, *arguments)
    return xrl(*words, run_dir=run_dir, timeout_s=170.0)


@pytest.mark.system
@pytest.mark.timeout(180)
def test_settings_are_written_after_a_backup_of_all_and_kept(run_dir: Path, tmp_path: Path) -> None:
    file = tmp_path / "changed.json"
    board = BoardBackup(MODULE, SERIAL, "0.5.6", {VEL_LIMIT: 50.0})
    write_backup(file, [board], time="", robot_file="")
    result = verb(run_dir, tmp_path / "b", "--restore", str(file), "--apply")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "settings written: 1;" in result.stdout
    assert f"unzeroed by the restart: {MODULE}; run `xrl drive zero`" in result.stdout
    (kept,) = (tmp_path / "b").glob("*.json")
    (before,) = read_backup(kept).boards
    assert (before.module, before.serial_number) == (MODULE, SERIAL)
    assert before.settings[VEL_LIMIT] == 60.0
    assert len(before.settings) > 60, "all settings, not those that are changed"


@pytest.mark.system
@pytest.mark.wide
@pytest.mark.timeout(180)
def test_a_board_is_led_through_its_calibration_and_no_other(run_dir: Path, tmp_path: Path) -> None:
    asked = ["--apply", "--calibrate", "--again", "--yes", "--module", MODULE]
    result = verb(run_dir, tmp_path, *asked)
    assert result.returncode == 0, result.stdout + result.stderr
    assert f"{MODULE}.axis1: 0.1 ohm, 50 uH, direction 1" in result.stdout
    assert f"unzeroed: {MODULE}; next, run `xrl drive zero" in result.stdout


@pytest.fixture
def flags(tmp_path: Path) -> configure.ConfigureFlags:
    return configure.ConfigureFlags(restore=tmp_path / "b.json")


def saved_as(serial: str, firmware: str = "0.5.6", **settings: Value) -> Backup:
    board = BoardBackup(MODULE, serial, firmware, settings)
    return Backup(time="", robot_file="", boards=(board,))


def test_a_backup_is_for_the_modules_that_it_has(
    robot: RobotConfig, flags: configure.ConfigureFlags
) -> None:
    assert configure.modules_of(flags, robot, saved_as(SERIAL.lower())) == (MODULE,)
    assert configure.modules_of(flags, robot, None) == MODULES
    other = dataclasses.replace(flags, module=("hip_left",))
    with pytest.raises(DriveError, match="no backup of hip_left in it, only of knee_left"):
        configure.modules_of(other, robot, saved_as(SERIAL))


def test_a_backup_of_another_board_is_refused(
    robot: RobotConfig, flags: configure.ConfigureFlags
) -> None:
    with pytest.raises(DriveError, match=f"3A00000000FF, but {SERIAL}"):
        configure.modules_of(flags, robot, saved_as("3A00000000FF"))


def test_a_backup_of_another_firmware_is_refused(robot: RobotConfig) -> None:
    boards = {MODULE: BoardInMemory(as_wanted())}
    with pytest.raises(DriveError, match=r"firmware 0\.5\.1, but the board has 0\.5\.6"):
        configure.differences(robot, boards, saved_as(SERIAL, "0.5.1"))
    difference = configure.differences(robot, boards, saved_as(SERIAL, **{VEL_LIMIT: 2.0}))
    assert [change.name for change in difference] == [VEL_LIMIT]


def test_a_board_that_is_not_there_or_not_known_is_refused(robot: RobotConfig) -> None:
    other = next(row.serial_number for row in robot.module if row.name != MODULE)
    absent = FoundBoards({}, {SERIAL: "not plugged in"}, (other, "0000000000AA"))
    with pytest.raises(DriveError, match=r"plugged in; plugged in, but in no .*: 0000000000AA\."):
        configure.boards_of(robot, [MODULE], absent)
    board = BoardInMemory({})
    for board.firmware in ((0, 6, 10), (0, 5, 1)):  # newer, and older than its settings' names
        named = ".".join(map(str, board.firmware))
        with pytest.raises(DriveError, match=f"firmware {named}"):
            configure.boards_of(robot, [MODULE], FoundBoards({SERIAL: board}, {}, ()))


class Interrupted(BoardInMemory):
    """A board at which somebody presses Ctrl-C while it is being written."""

    def write(self, values: Mapping[str, Value]) -> None:
        super().write(values)
        os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_finishes_the_board_that_was_begun_and_touches_no_other(robot: RobotConfig) -> None:
    """Half of a board's settings would be in force, and none saved."""
    boards = {
        module: kind(as_wanted() | {VEL_LIMIT: 2.0})
        for module, kind in zip(
            MODULES[:3], (BoardInMemory, Interrupted, BoardInMemory), strict=True
        )
    }
    difference = [
        change
        for module, board in boards.items()
        for change in changes_to_wanted(module, of_module(robot, MODULE), board)
    ]
    interrupts = Interrupts()
    with interrupts.kept():
        outcomes = configure.apply(Console(quiet=True), boards, difference, interrupts)
    assert interrupts.number == signal.SIGINT
    assert [board.kept[VEL_LIMIT] for board in boards.values()] == [60.0, 60.0, 2.0]
    assert [board.saves for board in boards.values()] == [1, 1, 0]
    assert [(o.change.module, o.good) for o in outcomes] == [(m, True) for m in MODULES[:2]]


def test_nothing_is_written_while_a_joint_service_is_up(robot: RobotConfig, run_dir: Path) -> None:
    make_live_dir(run_dir)
    endpoint = expand(robot.bus.endpoints[MODULE], run_dir).removeprefix("unixsock-stream/")
    configure.refuse_services(robot, run_dir, MODULES)
    with listening(Path(endpoint)), pytest.raises(FleetError, match=r"knee_left.*xrl down"):
        configure.refuse_services(robot, run_dir, MODULES)
    with listening(Path(endpoint)):
        configure.refuse_services(robot, run_dir, ["hip_left"])


def test_no_fleet_can_be_started_on_real_drives_meanwhile(real: RobotConfig, run_dir: Path) -> None:
    with (
        drive_access.no_fleet_meanwhile(real, run_dir),
        pytest.raises(FleetError, match="a fleet is up"),
    ):
        RunDir(run_dir).claim()
    assert not run_dir.exists()


def test_the_backup_is_written_before_anything_else_and_under_its_time(
    robot: RobotConfig, tmp_path: Path
) -> None:
    board = BoardInMemory(as_wanted() | {VEL_LIMIT: 2.0})
    path = configure.keep(tmp_path / "new", {MODULE: board}, Path("robot.toml"))
    assert board.writes == []
    (kept,) = read_backup(path).boards
    assert settings_of(kept) == as_wanted() | {VEL_LIMIT: 2.0}
    assert (kept.module, kept.firmware) == (MODULE, "0.5.6")
