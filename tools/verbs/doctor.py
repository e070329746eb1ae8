"""`xrl doctor`: checks the robot without moving or changing anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import msgspec
from rich.text import Text

from shared.can import drive_settings
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, DriveError, FleetError, MissingPackageError
from shared.joints import MODULES
from tools.bringup import can_monitor, check_board, check_host
from tools.bringup.boards import STATUS, Board, FoundBoards, Value, is_known, number
from tools.bringup.can_monitor import BusTraffic, bus_nodes, listen_to
from tools.bringup.drive_access import (
    boards_on_usb,
    drives_within_reach,
    is_up,
    robot_file,
)
from tools.bringup.findings import Finding, Groups, ok, report_of, show, warning, wrong
from tools.flags import FleetRobotFlags
from tools.fleet.process_table import is_simulated
from tools.terminal import Console

EXAMPLES: Final = """
xrl doctor
xrl doctor --config lab.toml --verbose
xrl doctor --json | jq '.groups[][] | select(.verdict == "wrong")'
"""

Progress = Callable[[str], None]

COMPUTER: Final = "this computer"
ROBOT: Final = "robot file and bus"
CAN: Final = "CAN"
DRIVES: Final = "drives, over USB"
HARNESS: Final = "harness"
IMU: Final = "IMU"
GROUPS: Final = (COMPUTER, ROBOT, CAN, DRIVES, HARNESS, IMU)


class DoctorFlags(FleetRobotFlags):
    """Format of the report."""

    verbose: bool = False
    """also show checks that are ok"""
    json: bool = False
    """print JSON"""


def run(flags: DoctorFlags) -> int:
    """Check everything; return 0 if nothing is wrong."""
    path = robot_file(flags)
    robot = config_file.load(path)
    with Console(stderr=True).status("checking") as status:
        groups = survey(
            robot,
            path,
            flags.run_dir,
            lambda words: status.update(Text(f"checking {words}")),
        )
    report = report_of(groups)
    if flags.json:
        print(msgspec.json.format(msgspec.json.encode(report)).decode())
    else:
        show(Console(), groups, verbose=flags.verbose)
    return 0 if report.ok else FAULT_EXIT_CODE


def survey(robot: RobotConfig, config_path: Path, run_dir: Path, progress: Progress) -> Groups:
    """Check everything; for an emulated robot without a fleet, start its simulator meanwhile."""
    fleet_is_up = is_up(run_dir)
    progress("this computer, the robot file, the bus")
    groups: Groups = {
        COMPUTER: check_host.machine_rows(robot),
        ROBOT: [
            *check_host.robot_rows(robot, config_path),
            *check_host.endpoint_rows(robot, run_dir, fleet_is_up=fleet_is_up),
            *check_host.security_rows(robot),
        ],
    }
    services_up = bool(check_host.joint_services_up(robot, run_dir))
    over_can = robot.joint_service.driver == "odrive_can"
    if is_simulated(robot) and not fleet_is_up:
        progress("the emulated drives; starting their simulator, because no fleet is up")
    with drives_within_reach(robot, config_path, run_dir):
        traffic = {}
        for name in bus_nodes(robot):
            if over_can or name in (robot.harness.bus, robot.imu.bus):
                progress(f"CAN bus {name}")
                traffic[name] = listen_to(robot, name, run_dir, poll_nodes=not services_up)
        progress("the drives over USB")
        usb = _Usb(robot, traffic, services_up=services_up)
        groups[DRIVES] = usb.rows(run_dir)
    if over_can:
        groups[CAN] = []
        for module in MODULES:
            heard = traffic[robot.module_named(module).bus]
            groups[CAN] += can_monitor.drive_rows(robot, module, heard, services_up=services_up)
    groups[HARNESS] = can_monitor.harness_rows(robot, traffic[robot.harness.bus])
    if robot.imu.fitted:
        groups[IMU] = can_monitor.imu_rows(robot, traffic[robot.imu.bus])
    return {name: groups[name] for name in GROUPS if name in groups}


class _Usb:
    """Checks over USB; a board that cannot be reached also gets a row."""

    def __init__(
        self, robot: RobotConfig, traffic: Mapping[str, BusTraffic], *, services_up: bool
    ) -> None:
        self._robot, self._traffic, self._services_up = robot, traffic, services_up
        self._on_usb = robot.joint_service.driver == "odrive_usb"
        self._read: dict[str, Mapping[str, Value]] = {}

    def rows(self, run_dir: Path) -> list[Finding]:
        rows: list[Finding] = []
        try:
            with boards_on_usb(self._robot, run_dir, MODULES) as found:
                for module in MODULES:
                    serial = self._robot.module_named(module).serial_number.upper()
                    board = found.boards.get(serial)
                    if board is None:
                        rows.append(self._unreached(module, *self._why_not(serial, found)))
                    else:
                        rows += self._board(module, board)
                    rows += self._position(module, board)
                rows += check_board.alike_rows(self._read)
        except (DriveError, FleetError, MissingPackageError) as error:
            found_out, _, fix = str(error).removeprefix("USB: ").partition("; ")
            rows.append(self._unreached("all drives", found_out, fix or "see the error"))
        return rows

    def _board(self, module: str, board: Board) -> list[Finding]:
        """Check a connected board and store its values."""
        rows = [
            ok(module, "USB", board.serial_number, "connected"),
            check_board.firmware_row(module, board.firmware),
        ]
        if not is_known(board.firmware):
            return rows
        try:
            settings, status = board.read(board.settings), board.read(STATUS)
            values = self._read[module] = {**settings, **status}
            wanted = drive_settings.of_module(self._robot, module)
            levels, up = check_board.trip_levels_of(settings), self._services_up
            return [
                *rows,
                *check_board.settings_rows(module, wanted, settings),
                *check_board.direction_rows(module, values, self._robot),
                *check_board.error_rows(module, status),
                *check_board.condition_rows(module, values, levels, services_up=up),
            ]
        except DriveError as error:
            return [self._unreached(module, str(error), "plug it in again; check its cable")]

    def _position(self, module: str, board: Board | None) -> list[Finding]:
        """Judge a module's position from its bus, or from its board if it is on no bus."""
        bus = self._traffic.get(self._robot.module_named(module).bus)
        turns = can_monitor.positions(self._robot, module, bus) if bus else None
        if turns is None and board is not None:
            try:
                names = [f"{axis}.encoder.pos_estimate" for axis in drive_settings.AXES]
                values = board.read(names)
                turns = (number(values, names[0]), number(values, names[1]))
            except DriveError:
                return []  # another row reports this
        return [] if turns is None else check_board.position_rows(module, turns, self._robot)

    def _why_not(self, serial: str, found: FoundBoards) -> tuple[str, str]:
        """Return why a module's board was not reached, and what to do."""
        there = found.in_no_module(self._robot)
        if not serial:
            return (
                f"no serial_number{there}",
                "set `serial_number` in its [[module]]; `odrivetool` shows it",
            )
        trouble = f"{serial}: {found.troubles.get(serial, 'not connected')}{there}"
        if self._services_up and self._on_usb:
            return trouble, "its joint service uses the USB; run `xrl down` first"
        return trouble, "plug in its USB cable; check its supply, libusb-1.0 and the udev rule"

    def _unreached(self, subject: str, found: str, fix: str) -> Finding:
        why = "its settings cannot be checked"
        if self._on_usb:
            return wrong(subject, "USB", found, "connected", fix, why)
        return warning(
            subject,
            "USB",
            found,
            "connected",
            fix,
            f"{why}: firmware 0.5 does not report them over CAN",
        )
