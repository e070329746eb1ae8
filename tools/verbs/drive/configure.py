"""`xrl drive configure`: backs up and writes the drives' settings, and calibrates the drives."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final

from shared.can import drive_settings
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, DriveError, FleetError
from shared.joints import MODULES
from tools.bringup import calibration, drive_access
from tools.bringup.boards import (
    FIRMWARE,
    Backup,
    Board,
    ChangeResult,
    FoundBoards,
    SettingChange,
    against_backup,
    backup_of,
    changes_to_wanted,
    describe_firmware,
    describe_setting,
    difference_table,
    is_known,
    read_backup,
    refuse_armed,
    settings_of,
    write_backup,
    write_changes,
)
from tools.bringup.check_host import joint_services_up
from tools.bringup.drive_access import (
    boards_on_usb,
    drives_within_reach,
    no_fleet_meanwhile,
)
from tools.bringup.motion_runner import LIFTED, Interrupts, exit_if_interrupted
from tools.flags import Arg, FleetRobotFlags, Folder, Module
from tools.fleet.process_table import is_simulated
from tools.terminal import Console, marked

BACKUPS: Final = Path("out") / "drive-backups"

EXAMPLES: Final = """
xrl drive configure
xrl drive configure --apply --module knee_left
xrl drive configure --apply --calibrate --module knee_left     # a new board; its leg hangs
xrl drive configure --restore out/drive-backups/20260301-101500.json --apply
"""


class ConfigureFlags(FleetRobotFlags):
    """Drives to configure, settings to write, and folder of the backup."""

    dry_run: Annotated[
        bool,
        Arg(
            exclusive="what",
            help="only show the differences, as without --apply; "
            f"exit code {FAULT_EXIT_CODE} if there are any",
        ),
    ] = False
    apply: Annotated[bool, Arg(exclusive="what")] = False
    """write and save the settings; the boards restart"""
    module: tuple[Module, ...] = ()
    """only this module; repeatable (default: all six, or with --restore those in the backup)"""
    restore: Annotated[Path | None, Arg(metavar="BACKUP.json")] = None
    """write a backup's settings instead of the robot file's"""
    out: Folder = BACKUPS
    """folder for the backup"""
    calibrate: bool = False
    """with --apply: then calibrate the uncalibrated axes; each motor moves about a turn and back,
    so the leg must hang; the drive loses its zero"""
    again: bool = False
    """with --calibrate: also recalibrate calibrated axes"""
    yes: bool = False
    """do not ask for confirmation"""

    def check(self) -> None:
        """Refuse flags that need --calibrate or contradict it."""
        super().check()
        if (self.again or self.yes) and not self.calibrate:
            raise DriveError("--again and --yes need --calibrate; add it")
        if self.calibrate and self.restore:
            raise DriveError("--calibrate and --restore cannot be combined; remove --restore")


def run(flags: ConfigureFlags) -> int:
    """Show the differences and, with --apply, write them; return 0 if the drives are as wanted."""
    console = Console()
    path = drive_access.robot_file(flags)
    robot = config_file.load_without_schedule(path)
    saved = read_backup(flags.restore) if flags.restore else None
    modules = modules_of(flags, robot, saved)
    looked_at = MODULES if flags.calibrate else modules
    with contextlib.ExitStack() as stack:
        if flags.apply:
            stack.enter_context(no_fleet_meanwhile(robot, flags.run_dir))
            refuse_services(robot, flags.run_dir, looked_at)
        lifted = LIFTED if flags.calibrate else 0.0
        started = stack.enter_context(
            drives_within_reach(robot, path, flags.run_dir, lifted=lifted)
        )
        found = stack.enter_context(boards_on_usb(robot, flags.run_dir, looked_at))
        boards = boards_of(robot, modules, found)
        axes = calibration.to_calibrate(boards, again=flags.again) if flags.calibrate else {}
        difference = differences(robot, boards, saved, axes)
        if not _show(console, flags, difference, axes) or not flags.apply:
            return FAULT_EXIT_CODE if difference or axes else 0
        interrupts = Interrupts()
        code = _write(flags, console, (robot, path), boards, difference, axes, found, interrupts)
    if started and is_simulated(robot):
        console.print(drive_access.GONE)
    exit_if_interrupted(interrupts)
    return code


def _show(
    console: Console,
    flags: ConfigureFlags,
    difference: Sequence[SettingChange],
    axes: Mapping[str, Sequence[str]],
) -> bool:
    """Print the pending changes; return False if there are none."""
    console.print(difference_table(difference) if difference else "nothing to change")
    for module, those in axes.items():
        console.print(f"to be calibrated: {module}, {' and '.join(those)}")
    if flags.calibrate and not axes:
        console.print("every axis is calibrated; use --again to recalibrate")
    if (difference or axes) and not flags.apply:
        console.print("\nnothing was written; use `--apply` to write")
    return bool(difference or axes)


def _write(
    flags: ConfigureFlags,
    console: Console,
    file: tuple[RobotConfig, Path],
    boards: Mapping[str, Board],
    difference: Sequence[SettingChange],
    axes: Mapping[str, Sequence[str]],
    found: FoundBoards,
    interrupts: Interrupts,
) -> int:
    """Back up, write, read back and calibrate; return the exit code."""
    robot, path = file
    for module, board in boards.items():
        refuse_armed(module, board)
    if axes:
        calibration.refuse_standing(robot, flags.run_dir, found, axes)
    kept = keep(flags.out, boards, path)
    restore = f"`xrl drive configure --restore {shlex.quote(str(kept))}`"
    console.print(f"\nbackup of the boards: {kept}; {restore} shows its differences")
    with interrupts.kept():
        outcomes = apply(console, boards, difference, interrupts)
    code = _conclude(console, robot, outcomes) if difference else 0
    if interrupts.number:
        begun = {outcome.change.module for outcome in outcomes}
        rest = dict.fromkeys(c.module for c in difference if c.module not in begun)
        console.print(
            f"stopped before {', '.join(rest)}" if rest else "stopped after the last board"
        )
        exit_if_interrupted(interrupts)
    if code or not axes:
        return code
    return calibration.calibrate(
        console, robot, {module: (boards[module], axes[module]) for module in axes},
        interrupts, yes=flags.yes, check=lambda: refuse_services(robot, flags.run_dir, MODULES),
    )  # fmt: skip


def modules_of(flags: ConfigureFlags, robot: RobotConfig, saved: Backup | None) -> tuple[str, ...]:
    """Return the given modules; by default those of the backup, or all without a backup.

    Raises:
        DriveError: the backup lacks a module, or is from another board than the robot file's.
    """
    if saved is None:
        return tuple(flags.module or MODULES)
    by_module = {board.module: board for board in saved.boards}
    modules = tuple(flags.module or by_module)
    for module in modules:
        if module not in by_module:
            there = ", ".join(by_module)
            raise DriveError(f"{flags.restore}: no backup of {module} in it, only of {there}")
        serial = robot.module_named(module).serial_number.upper() if module in MODULES else ""
        other = by_module[module].serial_number.upper()
        if serial != other:
            raise DriveError(
                f"{flags.restore}: {module} is ODrive {other}, but {serial or 'no serial_number'} "
                "in the robot file; a backup can only be restored to the board it came from"
            )
    return modules


def refuse_services(robot: RobotConfig, run_dir: Path, modules: Sequence[str]) -> None:
    """Raise FleetError if a joint service holds one of the drives."""
    for service in joint_services_up(robot, run_dir):
        if service in modules:
            raise FleetError(
                f"the joint service of {service} is up in {run_dir}, and saving settings restarts "
                "its board. Hang the robot and run `xrl down` first"
            )
    for module in modules:
        drive_access.refuse_service(robot, module, run_dir)


def boards_of(robot: RobotConfig, modules: Sequence[str], found: FoundBoards) -> dict[str, Board]:
    """Return the boards by module; all must be connected and have a known firmware."""
    boards = {}
    for module in modules:
        serial = robot.module_named(module).serial_number.upper()
        board = found.boards.get(serial)
        if board is None:
            raise DriveError(
                f"{module}: {serial or 'no serial_number in its [[module]]'}: "
                f"{found.troubles.get(serial, 'its board is unknown')}{found.in_no_module(robot)}. "
                "Settings are written over USB; `xrl doctor` says what is missing"
            )
        if not is_known(board.firmware):
            raise DriveError(
                f"{module}: firmware {describe_firmware(board.firmware)} is not supported; the "
                f"settings are for {describe_firmware(FIRMWARE)}. Flash that version first"
            )
        boards[module] = board
    return boards


def differences(
    robot: RobotConfig,
    boards: Mapping[str, Board],
    saved: Backup | None,
    axes: Mapping[str, Sequence[str]] | None = None,
) -> list[SettingChange]:
    """Return all settings to change, by module, except the calibration marks of axes to calibrate.

    A backup must be from the same firmware: a setting may mean something else in another one.
    """
    rows: list[SettingChange] = []
    kept = {board.module: board for board in saved.boards} if saved else {}
    for module, board in boards.items():
        if saved is None:
            rows += changes_to_wanted(module, drive_settings.of_module(robot, module), board)
            continue
        firmware = describe_firmware(board.firmware)
        if firmware != kept[module].firmware:
            raise DriveError(
                f"{module}: the backup is from firmware {kept[module].firmware}, but the board has "
                f"{firmware}, where settings may mean something else; it can only be restored to "
                "the same firmware"
            )
        rows += against_backup(module, settings_of(kept[module]), board)
    marks = {
        (module, f"{axis}.{mark}")
        for module, those in (axes or {}).items()
        for axis in those
        for mark in calibration.MARKS
    }
    return [row for row in rows if (row.module, row.name) not in marks]


def keep(folder: Path, boards: Mapping[str, Board], robot_file: Path) -> Path:
    """Write all settings of the boards into a new file and return its path."""
    path = folder / time.strftime("%Y%m%d-%H%M%S.json")
    rows = [backup_of(module, board) for module, board in boards.items()]
    write_backup(path, rows, time=time.strftime("%Y-%m-%dT%H:%M:%S%z"), robot_file=str(robot_file))
    return path


def apply(
    console: Console,
    boards: Mapping[str, Board],
    difference: Sequence[SettingChange],
    interrupts: Interrupts,
) -> list[ChangeResult]:
    """Write, save and read back the settings of one board after another, even after a failure.

    A board is finished before an interrupt takes effect: otherwise half of its settings would be
    active and none saved.
    """
    outcomes: list[ChangeResult] = []
    for module, board in boards.items():
        serial = [change for change in difference if change.module == module]
        if interrupts.number or not serial:
            continue
        try:
            with console.status(f"{module}: writing, saving, restarting"):
                outcomes += write_changes(board, serial)
        except DriveError as error:
            console.print(marked("[bold red]{}[/]: {}", module, error))
            outcomes += [ChangeResult(change, None, good=False) for change in serial]
    return outcomes


def _conclude(console: Console, robot: RobotConfig, outcomes: Sequence[ChangeResult]) -> int:
    """Print the results and return the exit code."""
    bad = [outcome for outcome in outcomes if not outcome.good]
    for change, now, _ in bad:
        what = change.inhibit or f"it is {describe_setting(now)} after the restart"
        console.print(
            marked("[bold red]not as wanted[/]: {} {}: {}", change.module, change.name, what)
        )
    done = len(outcomes) - len(bad)
    console.print(f"settings written: {done}; saved, and read back after the restart")
    if done and robot.drive.zero_mark_turns > 0.0:
        written = (outcome.change for outcome in outcomes if not outcome.change.inhibit)
        restarted = dict.fromkeys(change.module for change in written)
        console.print(f"unzeroed by the restart: {', '.join(restarted)}; run `xrl drive zero`")
    return FAULT_EXIT_CODE if bad else 0
