"""The doctor's round: every check, in groups; nothing is moved and nothing is changed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from shared.can import drive_settings
from shared.config.robot_config import RobotConfig, expand
from shared.config.sections import CanConfig
from shared.exceptions import DriveError, FleetError, MissingPackageError
from shared.joints import MODULES
from tools.bringup import check_alike, check_board, check_can, check_machine, check_robot
from tools.bringup.boards import STATUS, Board, FoundBoards, Value, is_known, number
from tools.bringup.can_monitor import BusTraffic, listen, long_enough
from tools.bringup.drive_access import boards_on_usb, drives_within_reach, is_up
from tools.bringup.findings import Finding, Groups, ok, warning, wrong
from tools.fleet.process_table import is_simulated

Progress = Callable[[str], None]

COMPUTER: Final = "this computer"
ROBOT: Final = "robot file and bus"
CAN: Final = "CAN"
DRIVES: Final = "drives, over USB"
HARNESS: Final = "harness"
IMU: Final = "IMU"
GROUPS: Final = (COMPUTER, ROBOT, CAN, DRIVES, HARNESS, IMU)


def survey(
    robot: RobotConfig, config_path: Path, run_dir: Path, plants: Sequence[str], progress: Progress
) -> Groups:
    """Check everything; if no fleet is up, an emulated robot's simulator runs meanwhile.

    Args:
        robot: from the robot file.
        config_path: the robot file.
        run_dir: of the fleet.
        plants: settings that the emulated drives have kept.
        progress: receives the subject of each check.
    """
    fleet_is_up = is_up(run_dir)
    progress("this computer, the robot file, the bus")
    groups: Groups = {
        COMPUTER: check_machine.machine_rows(robot),
        ROBOT: [
            *check_robot.robot_rows(robot, config_path),
            *check_robot.endpoint_rows(robot, run_dir, fleet_is_up=fleet_is_up),
            *check_robot.security_rows(robot),
        ],
    }
    services_up = bool(check_robot.joint_services(check_robot.services_up(robot, run_dir)))
    if is_simulated(robot) and not fleet_is_up:
        progress("starting the simulator: the drives are emulated, and no fleet is up")
    with drives_within_reach(robot, config_path, run_dir, plants):
        traffic = _listen(robot, run_dir, services_up=services_up, progress=progress)
        progress("the drives over USB")
        groups[DRIVES] = _usb(robot, run_dir, traffic, services_up=services_up)
    if robot.joint_service.driver == "odrive_can":
        groups[CAN] = []
        for module in MODULES:
            heard = traffic[robot.module_named(module).bus]
            groups[CAN] += check_can.drive_rows(robot, module, heard, services_up=services_up)
    groups[HARNESS] = check_can.harness_rows(robot, traffic[robot.harness.bus])
    if robot.imu.fitted:
        groups[IMU] = check_can.imu_rows(robot, traffic[robot.imu.bus])
    return {name: groups[name] for name in GROUPS if name in groups}


def _listen(
    robot: RobotConfig, run_dir: Path, *, services_up: bool, progress: Progress
) -> dict[str, BusTraffic]:
    """Listen to every bus of the robot, one after the other."""
    present = {}
    on_usb = robot.joint_service.driver == "odrive_usb"
    for name, nodes in check_can.bus_nodes(robot).items():
        if on_usb and name not in (robot.harness.bus, robot.imu.bus):
            continue
        progress(f"CAN bus {name}")
        bus = robot.can[name]
        present[name] = listen(
            CanConfig(interface=bus.interface, channel=expand(bus.channel, run_dir)),
            nodes,
            poll_nodes=not services_up,
            cells=name == robot.harness.bus,
            imu=robot.imu.fitted and name == robot.imu.bus,
            seconds=long_enough(robot.drive.heartbeat_period_ms if nodes else 0),
        )
    return present


def _usb(
    robot: RobotConfig, run_dir: Path, traffic: dict[str, BusTraffic], *, services_up: bool
) -> list[Finding]:
    """Check every module's board; what of it cannot be reached over USB is a row too."""
    rows: list[Finding] = []
    read: dict[str, Mapping[str, Value]] = {}
    try:
        with boards_on_usb(robot, run_dir, MODULES) as found:
            for module in MODULES:
                board = found.boards.get(robot.module_named(module).serial_number.upper())
                if board is None:
                    why = _why_not(robot, module, found, services_up=services_up)
                    rows.append(_unreached(robot, module, *why))
                else:
                    rows += _board(robot, module, board, read, services_up=services_up)
                rows += _position(robot, module, board, traffic)
            rows += check_alike.alike_rows(read)
    except (DriveError, FleetError, MissingPackageError) as error:
        found_out, _, fix = str(error).removeprefix("USB: ").partition("; ")
        rows.append(_unreached(robot, "all drives", found_out, fix or "see there"))
    return rows


def _board(
    robot: RobotConfig,
    module: str,
    board: Board,
    read: dict[str, Mapping[str, Value]],
    *,
    services_up: bool,
) -> list[Finding]:
    """Check a board that is connected, and add its settings to `read`."""
    rows = [
        ok(module, "USB", board.serial_number, "there"),
        check_board.firmware_row(module, board.firmware),
    ]
    if not is_known(board.firmware):
        return rows
    try:
        settings, status = board.read(board.settings), board.read(STATUS)
        read[module] = {**settings, **status}
        wanted = drive_settings.of_module(robot, module)
        levels = check_board.trip_levels_of(settings)
        return [
            *rows,
            *check_board.settings_rows(module, wanted, settings),
            *check_board.direction_rows(module, read[module], robot),
            *check_board.error_rows(module, status),
            *check_board.condition_rows(module, read[module], levels, services_up=services_up),
        ]
    except DriveError as error:
        return [_unreached(robot, module, str(error), "plug it in again; look at its cable")]


def _position(
    robot: RobotConfig, module: str, board: Board | None, traffic: dict[str, BusTraffic]
) -> list[Finding]:
    """Judge where a module is, by its bus if it is on one, else by its board."""
    bus = traffic.get(robot.module_named(module).bus)
    turns = check_can.positions(robot, module, bus) if bus else None
    if turns is None and board is not None:
        try:
            names = [f"{axis}.encoder.pos_estimate" for axis in drive_settings.AXES]
            values = board.read(names)
            turns = (number(values, names[0]), number(values, names[1]))
        except DriveError:
            return []  # its own row says so
    return [] if turns is None else check_board.position_rows(module, turns, robot)


def _why_not(
    robot: RobotConfig, module: str, found: FoundBoards, *, services_up: bool
) -> tuple[str, str]:
    """Return why a module's board was not reached, and what to do."""
    serial, strangers = robot.module_named(module).serial_number.upper(), ", ".join(found.strangers)
    there = f"; plugged in and in no [[module]]: {strangers}" if strangers else ""
    if not serial:
        return f"no serial_number{there}", "`serial_number` in its [[module]], by `odrivetool`"
    trouble = f"{serial}: {found.troubles.get(serial, 'not there')}{there}"
    if services_up and robot.joint_service.driver == "odrive_usb":
        return trouble, "its joint service has the USB: `xrl down` first"
    return trouble, "plug its USB cable in; supply on; libusb-1.0 and the udev rule are there"


def _unreached(robot: RobotConfig, subject: str, found: str, fix: str) -> Finding:
    """Return the row of a board that USB does not reach: its settings stay unknown."""
    why = "its settings are not read back"
    if robot.joint_service.driver == "odrive_usb":
        return wrong(subject, "USB", found, "there", fix, why)
    return warning(subject, "USB", found, "there", fix, f"{why}: CAN of firmware 0.5 cannot")
