"""`python -m services.simulator`: a simulated robot in place of a real one."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from services.simulator.drives.axis_bank import AxisBank
from services.simulator.fronts.cansimple_front import CanSimpleFront
from services.simulator.fronts.fibre_front import EmulatedBoard, FibreFront
from services.simulator.fronts.fibre_port import FibreHub, FibrePort
from services.simulator.fronts.unix_can_hub import UnixCanHub
from services.simulator.fronts.usb_standin import FOLDER
from services.simulator.loop import SimulatorLoop, SimulatorPorts
from services.simulator.physics.plant import plant_from
from services.simulator.robot import SimulatedRobot, axes_by_bus
from shared import log, scheduling
from shared.bus import topics
from shared.bus.messages import HandLead, OperatorIntent, SimControl
from shared.bus.session import open_session
from shared.bus.traces import SimState, SimTruth
from shared.config import files as config_file
from shared.config import scenarios
from shared.config.robot_config import RobotConfig, expand
from shared.joints import MODULE_INDEX
from shared.places import SCENARIOS
from shared.process import StopFlag, freeze_garbage, run_service, service_parser
from shared.run_directory import live_dir, make_live_dir

DEFAULT_SCENARIO = SCENARIOS / "stand.toml"


def main() -> int:
    """Connect the world to the emulated drives and the bus, and run it; return the exit code."""
    parser = service_parser(
        "Simulate the robot, its drives and its operator.",
        "python -m services.simulator --scenario deploy/scenarios/squat.toml",
    )
    parser.add_argument("--scenario", type=Path, default=DEFAULT_SCENARIO, help="scenario file")
    parser.add_argument(
        "--autostart",
        type=float,
        metavar="S",
        help="start the scenario S seconds after the hoist is down (default: at a tool's request)",
    )
    parser.add_argument(
        "--plant",
        action="append",
        default=[],
        metavar="NAME|FILE|KEY=VALUE",
        help="how the true robot differs from the robot file: realistic (default), ideal, a TOML "
        "file, or one value; may be given several times",
    )
    parser.add_argument(
        "--lifted",
        type=float,
        default=0.0,
        metavar="M",
        help="hang the robot with its soles M metres above the floor (default: 0)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the sensors' noise")
    arguments = parser.parse_args()
    logger = log.setup("simulator")
    robot = config_file.load(arguments.config)
    scenario = scenarios.load(arguments.scenario)
    true_plant = plant_from(arguments.plant)
    stop = StopFlag()
    granted = scheduling.apply("simulator")
    with ExitStack() as stack:
        session = stack.enter_context(open_session(robot, "simulator", arguments.run_dir))
        ports = SimulatorPorts(
            truth=session.publisher(topics.SIM_TRUTH, SimTruth),
            intent=session.publisher(topics.OPERATOR_INTENT, OperatorIntent),
            control=session.latest(topics.SIM_CONTROL, SimControl),
            state=session.publisher(topics.SIM_STATE, SimState),
            asked=session.latest(topics.OPERATOR_INTENT, OperatorIntent),
            hand=session.latest(topics.OPERATOR_HAND, HandLead),
        )
        hubs = _open_hubs(robot, arguments.run_dir, stack)
        made = SimulatedRobot(
            robot, true_plant, scenario, cells=hubs[robot.harness.bus],
            imu=hubs[robot.imu.bus] if robot.imu.fitted else None, seed=arguments.seed,
            lifted=arguments.lifted,
        )  # fmt: skip
        buses = axes_by_bus(robot)
        front = CanSimpleFront(
            made.bank,
            [hubs[name] for name in buses],
            list(buses.values()),
            heartbeat_period_ms=robot.drive.heartbeat_period_ms,
            dialect=robot.simulation.can_dialect,
        )
        usb = _open_usb(robot, made.bank, arguments.run_dir, stack)
        logger.info("up, %s, scenario %s", granted, scenario.name)
        freeze_garbage()
        loop = SimulatorLoop(robot, made, front, usb, ports)
        loop.autostart_s = arguments.autostart
        loop.run(stop)
    logger.info("stopped")
    return 0


def _open_hubs(robot: RobotConfig, run_dir: Path, stack: ExitStack) -> dict[str, UnixCanHub]:
    make_live_dir(run_dir)
    sensors = [robot.harness.bus, *([robot.imu.bus] if robot.imu.fitted else [])]
    hubs = {
        name: stack.enter_context(UnixCanHub(Path(expand(robot.can[name].channel, run_dir))))
        for name in dict.fromkeys([*axes_by_bus(robot), *sensors])
    }
    for name in sensors:
        hubs[name].shared = True
    return hubs


def _open_usb(
    robot: RobotConfig, bank: AxisBank, run_dir: Path, stack: ExitStack
) -> list[FibreHub]:
    """Return the USB ports of the modules with serial numbers, in `FOLDER` of the live directory.

    An ODrive v3 has USB and CAN, so the ports exist even if the services use CAN.
    """
    folder = live_dir(run_dir) / FOLDER
    ports: list[FibrePort] = []
    for module in robot.module:
        if module.serial_number:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            board = EmulatedBoard(bank, MODULE_INDEX[module.name], int(module.serial_number, 16))
            ports.append(FibrePort(FibreFront(board), folder / module.serial_number.upper()))
            stack.callback(ports[-1].unplug)
    if not ports:
        return []
    hub = FibreHub(ports)
    stack.callback(hub.close)
    return [hub]


if __name__ == "__main__":
    run_service(main)
