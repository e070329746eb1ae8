"""Restores a drive's own limits after a motion to those of the robot file.

A drive keeps a motion's small limits until a service arms it or it restarts. `xrl doctor` would
find them wrong, and `xrl drive configure --apply` would restart the board: it loses its zero.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from services.joint.drivers.can_link import CanLink
from services.joint.drivers.odrive_frames import messages_of
from shared.can import cansimple
from shared.can.cansimple import Command
from shared.can.drive_settings import AXES
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError, XrlError
from tools.bringup.boards import Value, equal
from tools.bringup.can_monitor import bus_config
from tools.bringup.drive_access import boards_on_usb

TIMES: Final = 3
"""CAN of firmware 0.5 does not tell its limits, and a frame may be lost."""
_APART_S: Final = 0.02


def give_back(robot: RobotConfig, module: str, run_dir: Path) -> None:
    """Set the limits of a module's drive, which must be idle and nobody's, to the robot file's."""
    if robot.joint_service.driver == "odrive_usb":
        _over_usb(robot, module, run_dir)
    else:
        _over_can(robot, module, run_dir)


def not_given_back(robot: RobotConfig, module: str, run_dir: Path) -> str:
    """Give the limits back; return what to tell of a drive that did not take them, "" if it did."""
    try:
        give_back(robot, module, run_dir)
    except XrlError as error:
        return (
            f"the drive still has the limits of this motion ({error}): until it is armed by its "
            "service or restarted, `xrl doctor` finds them wrong"
        )
    return ""


def _over_can(robot: RobotConfig, module: str, run_dir: Path) -> None:
    wiring, drive = robot.module_named(module), robot.drive
    limits = (Command.SET_LIMITS, cansimple.pack_two_floats(drive.vel_limit, drive.current_lim))
    link = CanLink(bus_config(robot, wiring.bus, run_dir), wiring.node_ids)
    try:
        taken = link.connect()
        for _ in range(TIMES):
            link.receive(_APART_S)  # nothing is sent to a drive that is not heard
            taken = taken and link.send(messages_of(wiring.node_ids, (limits,)))
    finally:
        link.close()
    if not taken:
        raise DriveError(f"CAN bus {wiring.bus} takes no frames")


def _over_usb(robot: RobotConfig, module: str, run_dir: Path) -> None:
    serial, drive = robot.module_named(module).serial_number.upper(), robot.drive
    wanted: dict[str, Value] = {}
    for axis in AXES:
        wanted[f"{axis}.controller.config.vel_limit"] = drive.vel_limit
        wanted[f"{axis}.motor.config.current_lim"] = drive.current_lim
    with boards_on_usb(robot, run_dir, [module]) as found:
        if serial not in found.boards:
            raise DriveError(f"ODrive {serial}: {found.troubles.get(serial, 'not there')}")
        board = found.boards[serial]
        board.write(wanted)
        kept = board.read(wanted)
    if not all(equal(kept.get(name), value) for name, value in wanted.items()):
        raise DriveError(f"ODrive {serial}: it did not keep them")
