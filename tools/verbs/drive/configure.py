"""`xrl drive configure`: write the drives' settings, after a backup; calibrate what is not."""

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
xrl drive configure                          # shows what it would change, writes nothing
xrl drive configure --apply
xrl drive configure --apply --module knee_left
xrl drive configure --apply --calibrate --module knee_left     # a new board; its leg hangs
xrl drive configure --restore out/drive-backups/20260301-101500.json --apply
"""


class ConfigureFlags(FleetRobotFlags):
    """Which drives, what is written, and where the backup goes."""

    dry_run: Annotated[
        bool,
        Arg(
            exclusive="what",
            help="show the difference only, as without --apply; "
            f"exit code {FAULT_EXIT_CODE} if there is one",
        ),
    ] = False
    apply: Annotated[bool, Arg(exclusive="what")] = False
    """write and save it; the boards restart"""
    module: tuple[Module, ...] = ()
    """only this module; may be given several times (default: all six)"""
    restore: Annotated[Path | None, Arg(metavar="BACKUP.json")] = None
    """write a backup's settings instead of the robot file's"""
    out: Folder = BACKUPS
    """where the backup is written"""
    calibrate: bool = False
    """then calibrate the axes that are not, their leg hanging: each motor turns by about a turn and
    back; the drive forgets its zero"""
    again: bool = False
    """with --calibrate: those as well that are calibrated"""
    yes: bool = False
    """with --calibrate: do not ask"""

    def check(self) -> None:
        """Refuse flags that mean nothing without a calibration, or with it."""
        super().check()
        if (self.again or self.yes) and not self.calibrate:
            raise DriveError("--again and --yes go with --calibrate")
        if self.calibrate and self.restore:
            raise DriveError("--calibrate finds what no backup knows; leave --restore out")


def run(flags: ConfigureFlags) -> int:
    """Show the differences, and write them if told to; return 0 if the drives are as wanted."""
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
    """Print what is to do; return False if it is nothing."""
    console.print(difference_table(difference) if difference else "nothing to change")
    for module, those in axes.items():
        console.print(f"to be calibrated: {module}, {' and '.join(those)}")
    if flags.calibrate and not axes:
        console.print("every axis is calibrated; --again calibrates them once more")
    if (difference or axes) and not flags.apply:
        console.print("\nnothing was written; `--apply` does it")
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
    """Keep a backup, write, read back, and calibrate; return the exit code."""
    robot, path = file
    for module, board in boards.items():
        refuse_armed(module, board)
    if axes:
        calibration.refuse_standing(robot, flags.run_dir, found, axes)
    kept = keep(flags.out, boards, path)
    restore = f"`xrl drive configure --restore {shlex.quote(str(kept))}`"
    console.print(f"\nwhat the boards had: {kept}; {restore} shows it")
    with interrupts.kept():
        outcomes = apply(console, boards, difference, interrupts)
    code = _conclude(console, robot, outcomes) if difference else 0
    if interrupts.number:
        begun = {outcome.change.module for outcome in outcomes}
        rest = dict.fromkeys(c.module for c in difference if c.module not in begun)
        console.print(f"stopped before {', '.join(rest)}" if rest else "nothing was left to do")
        exit_if_interrupted(interrupts)
    if code or not axes:
        return code
    return calibration.calibrate(
        console, robot, {module: (boards[module], axes[module]) for module in axes},
        interrupts, yes=flags.yes, check=lambda: refuse_services(robot, flags.run_dir, MODULES),
    )  # fmt: skip


def modules_of(flags: ConfigureFlags, robot: RobotConfig, saved: Backup | None) -> tuple[str, ...]:
    """Return the named modules, or those of the backup, which must be of the same boards."""
    if saved is None:
        return tuple(flags.module or MODULES)
    by_module = {board.module: board for board in saved.boards}
    modules = tuple(flags.module or by_module)
    for module in modules:
        if module not in by_module:
            raise DriveError(f"{flags.restore}: it has no {module}; it has {', '.join(by_module)}")
        serial = robot.module_named(module).serial_number.upper() if module in MODULES else ""
        other = by_module[module].serial_number.upper()
        if serial != other:
            raise DriveError(
                f"{flags.restore}: {module} is ODrive {other} there and {serial or 'unnamed'} in "
                "the robot file; a backup can be restored only onto the board it came from"
            )
    return modules


def refuse_services(robot: RobotConfig, run_dir: Path, modules: Sequence[str]) -> None:
    """Refuse to write where a joint service has one of the drives."""
    for service in joint_services_up(robot, run_dir):
        if service in modules:
            raise FleetError(
                f"the joint service of {service} is up in {run_dir}: saving settings restarts the "
                "board under it. Hang the robot; `xrl down` first"
            )
    for module in modules:
        drive_access.refuse_service(robot, module, run_dir)


def boards_of(robot: RobotConfig, modules: Sequence[str], found: FoundBoards) -> dict[str, Board]:
    """Return the boards by module; every one must be there, with a firmware that is known here."""
    boards = {}
    for module in modules:
        serial = robot.module_named(module).serial_number.upper()
        board = found.boards.get(serial)
        if board is None:
            raise DriveError(
                f"{module}: {serial or 'no serial_number in its [[module]]'}: "
                f"{found.troubles.get(serial, 'not known')}{found.in_no_module(robot)}. "
                "Settings are written over USB; `xrl doctor` says what is missing"
            )
        if not is_known(board.firmware):
            raise DriveError(
                f"{module}: firmware {describe_firmware(board.firmware)}; these settings are those "
                f"of {describe_firmware(FIRMWARE)}"
            )
        boards[module] = board
    return boards


def differences(
    robot: RobotConfig,
    boards: Mapping[str, Board],
    saved: Backup | None,
    axes: Mapping[str, Sequence[str]] | None = None,
) -> list[SettingChange]:
    """Return everything to change, module by module, but the marks of axes to be calibrated.

    A backup must be of the same firmware: settings may mean something else in another.
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
                f"{module}: the backup is of firmware {kept[module].firmware}, the board has "
                f"{firmware}: settings may mean something else there"
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
    """Write, save and read back one board after the other; one that fails does not stop the others.

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
    """Say what came of it and return the exit code."""
    bad = [outcome for outcome in outcomes if not outcome.good]
    for change, now, _ in bad:
        what = change.inhibit or f"it is {describe_setting(now)} after the restart"
        console.print(
            marked("[bold red]not as wanted[/]: {} {}: {}", change.module, change.name, what)
        )
    done = len(outcomes) - len(bad)
    console.print(f"{done} settings written, saved, and read back after the restart")
    if done and robot.drive.zero_mark_turns > 0.0:
        written = (outcome.change for outcome in outcomes if not outcome.change.inhibit)
        restarted = dict.fromkeys(change.module for change in written)
        console.print(f"restarted and therefore unzeroed: {', '.join(restarted)}; `xrl drive zero`")
    return FAULT_EXIT_CODE if bad else 0
