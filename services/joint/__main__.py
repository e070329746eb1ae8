"""`python -m services.joint MODULE`: runs the joint service of one module."""

from __future__ import annotations

import signal
from pathlib import Path

from services.joint.drive_manager import DriveManager
from services.joint.drivers.base import Drive
from services.joint.drivers.odrive_can import OdriveCan
from services.joint.drivers.wired_drive import MotorFrame, WiredDrive
from services.joint.heat import HeatFile
from services.joint.loop import JointLoop, JointPorts
from services.joint.neighbours import Neighbours
from services.joint.rearm_guard import LastState, RearmGuard
from shared import log, planner_life, scheduling
from shared.bus import topics
from shared.bus.messages import Estop, JointCommand, JointEvent, JointState
from shared.bus.session import open_session
from shared.bus.traces import JointTrace
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig, expand
from shared.config.sections import CanConfig
from shared.extras import require
from shared.joints import MODULES
from shared.planner_life import PlannerLife
from shared.process import (
    StopFlag,
    freeze_garbage,
    run_service,
    service_parser,
)


def main() -> int:
    """Connect the controller to its drive and the bus, and run it."""
    parser = service_parser(
        "Control one 2-DOF module.", "python -m services.joint ankle_right --run-dir /tmp/xrl"
    )
    parser.add_argument("module", choices=MODULES)
    parser.add_argument(
        "--readonly",
        action="store_true",
        help="read the drive and publish its state, but send it no commands; for bring-up",
    )
    arguments = parser.parse_args()
    module: str = arguments.module
    logger = log.setup(module)
    robot = config_file.load(arguments.config)
    stop = StopFlag()
    granted = scheduling.apply("joint", module)
    with open_session(robot, module, arguments.run_dir) as session:
        ports = JointPorts(
            commands=session.latest(topics.JOINT_COMMAND, JointCommand, module),
            estops=session.latest(topics.ESTOP, Estop),
            states=session.publisher(topics.JOINT_STATE, JointState, module),
            events=session.publisher(topics.JOINT_EVENT, JointEvent, module),
            traces=session.publisher(topics.JOINT_TRACE, JointTrace, module),
            planner=planner_life.if_possible(PlannerLife, arguments.run_dir),
        )
        drive = open_drive(robot, module, arguments.run_dir, read_only=arguments.readonly)
        rearm_guard = None if arguments.readonly else RearmGuard(arguments.run_dir, module)
        if rearm_guard is not None:
            rearm_guard.stop_on(signal.SIGUSR1)  # works even if the file's disk is gone
        last_state = LastState.NOTHING if rearm_guard is None else rearm_guard.read()
        neighbours = None if arguments.readonly else Neighbours(arguments.run_dir, module)
        loop = JointLoop(
            robot, DriveManager(robot, module, last_state), drive, ports, rearm_guard, neighbours,
            heat_file=HeatFile(arguments.run_dir, module),
        )  # fmt: skip
        logger.info("up, %s%s", granted, ", read-only" if arguments.readonly else "")
        freeze_garbage()
        loop.run(stop)
        drive.close()
    logger.info("stopped")
    return 0


def open_drive(robot: RobotConfig, module: str, run_dir: Path, *, read_only: bool = False) -> Drive:
    """Return the module's drive, on CAN or USB; positions are in turns from the joint's zero."""
    frame = MotorFrame(robot.drive.zero_mark_turns, robot.module_named(module).motor_signs)
    return WiredDrive(_open(robot, module, run_dir), frame, read_only=read_only)


def _open(robot: RobotConfig, module: str, run_dir: Path) -> Drive:
    wiring = robot.module_named(module)
    if robot.joint_service.driver == "odrive_usb":
        require("usb")
        from services.joint.drivers.odrive_usb import OdriveUsb  # noqa: PLC0415

        return OdriveUsb(wiring.serial_number, robot.drive)
    bus = robot.can[wiring.bus]
    return OdriveCan(
        CanConfig(interface=bus.interface, channel=expand(bus.channel, run_dir)),
        wiring.node_ids,
        robot.drive,
        encoder_counts_per_turn=robot.joint.encoder_counts_per_turn,
    )


if __name__ == "__main__":
    run_service(main)
