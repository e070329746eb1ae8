"""`xrl up`: start the fleet."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from services.planner.controller_file import ATTACHED, absolute, controller_maker, split_spec
from services.ros2_gateway.inbound import acceptable
from services.ros2_gateway.rmw import domain
from services.simulator.physics.plant import plant_from
from shared.bus.credentials import keys_folder, require_operator
from shared.bus.topics import HOST_RECORDER
from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import BusError, FleetError, RunError
from shared.extras import require
from shared.joints import MODULES
from tools.fleet.fleet_status import OPEN
from tools.fleet.pace import add_pace
from tools.fleet.process_table import FleetOptions, check_known, is_simulated, load_table
from tools.fleet.status_table import warn_of_others
from tools.fleet.supervise import SupervisedFleet
from tools.keys.inspection import inspect_keys
from tools.live.experiment import add_controller, add_plant, make_out, scenario_file
from tools.number_arguments import finite
from tools.terminal import Console, marked
from tools.verb_table import Subparsers, add_config, add_run_dir, add_verb
from tools.view.live import LiveSource
from tools.view.serving import add_port, serve

SETTLE_S = 3.0
"""A scenario starts so long after the hoist is down."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "up",
        """
        xrl up
        xrl up --scenario crawl --out out/crawl
        xrl up --view                                  # and lead it by hand, in a browser
        xrl up --ros2                                  # seen by ROS 2: docs/ros2.md
        xrl up --ros2 --domain 7 --accept estop        # which may stop it, too
        xrl up --injectable                            # then: xrl inject --link ... --delay 30
        xrl up --config lab.toml --no-sim
        xrl up --config lab.toml --no-sim --only ankle_left,knee_left,hip_left  # of one host
        xrl up --config lab.toml --no-sim --only hip_left,host_recorder         # and its record
        xrl up --config lab.toml --no-sim --disarmed   # from a systemd unit
        xrl up --config lab.toml --no-sim --readonly   # move the joints by hand, and look
        """,
    )
    add_config(parser)
    add_run_dir(parser)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where the recorder writes (default: out/ and the time)",
    )
    parser.add_argument(
        "--scenario",
        metavar="NAME|FILE",
        help="what the simulated operator does once the robot stands: a file, or a name from "
        "deploy/scenarios (its kills are left to you)",
    )
    add_plant(parser)
    add_controller(parser)
    add_pace(parser)
    parser.add_argument(
        "--no-sim",
        action="store_true",
        help="start no simulator: the drives are real, or come later",
    )
    parser.add_argument(
        "--only",
        type=_names,
        metavar="SERVICE,...",
        help="only these: the robot's other services run on other hosts, where their endpoints in "
        "the robot file are",
    )
    parser.add_argument(
        "--snapshot",
        type=finite,
        metavar="SECONDS",
        help="record nothing until a fault, then SECONDS before and after it",
    )
    parser.add_argument(
        "--no-planner",
        action="store_true",
        help="six modules that HOLD by themselves; `xrl start planner` lets it lead",
    )
    parser.add_argument(
        "--injectable",
        action="store_true",
        help="put the network proxy between planner, joints and sensors, for `xrl inject`",
    )
    parser.add_argument(
        "--disarmed",
        action="store_true",
        help="arm no drive until a person asks (xrl kill MODULE); one that holds is taken over: "
        "for a start by itself, after a power cut",
    )
    parser.add_argument(
        "--view",
        action="store_true",
        help="then show it in a browser until Ctrl-C, as `xrl view` does; a page may act on a "
        "simulated robot. The fleet stays up",
    )
    add_port(parser)
    parser.add_argument(
        "--ros2",
        action="store_true",
        help="show it to ROS 2 over Zenoh: joint states, transforms, diagnostics (docs/ros2.md)",
    )
    parser.add_argument(
        "--domain",
        type=domain,
        metavar="N",
        help="with --ros2: its domain (default: $ROS_DOMAIN_ID, else 0)",
    )
    parser.add_argument(
        "--accept",
        type=acceptable,
        metavar="TOPICS",
        help="with --ros2: let ROS 2 ask for assist (intent), stop the robot (estop), or both "
        "(intent,estop)",
    )
    parser.add_argument(
        "--readonly",
        action="store_true",
        help="the joint services listen to their drives and publish, and send them nothing",
    )


def run(args: argparse.Namespace) -> int:
    """Start the fleet and say where it is."""
    if args.view:
        require("view", "leave --view")
    robot = config_file.load(args.config)
    gain_schedule.require(robot, args.config)
    if robot.bus.security.mode == "mtls":
        _check_keys(robot, must=not args.disarmed)
    services = _services(args)
    out = args.out or Path("out") / time.strftime("%Y%m%d-%H%M%S")
    if args.controller is not None:
        controller_maker(args.controller, robot)  # refused before anything is started
    overrides = _overrides(args, out)
    if args.ros2:
        overrides["ros2_gateway"] = _ros2_words(args, robot)
    if services is not None:
        overrides = {name: words for name, words in overrides.items() if name in services}
    recorders = {"recorder", HOST_RECORDER}
    if services is None or recorders & set(services):
        _make_record_folder(out, must=not args.disarmed)
    not_started = args.no_planner and (services is None or "planner" in services)
    fleet = SupervisedFleet.start(
        args.config,
        args.run_dir,
        FleetOptions(
            overrides=overrides,
            services=services,
            not_started=("planner",) if not_started else (),
            simulation=not args.no_sim,
            injected=args.injectable,
            ros2=args.ros2,
            pace=args.pace,
            disarmed=args.disarmed,
        ),
    )
    warn_of_others(Console(), own=fleet.run.path)
    up = len(fleet.manifest.services) - not_started
    record = f", record: {out}" if recorders & set(fleet.manifest.services) else ""
    print(
        f"{up} service{'s are' if up != 1 else ' is'} up in {fleet.run.path} "
        f"(logs: {fleet.run.logs}{record}); `xrl status` shows them, `xrl down` stops them"
    )
    if robot.bus.security.mode == "open":
        Console().print(marked("[bold red]{}[/]", OPEN))
    if args.view:
        live = LiveSource(robot, fleet, act="simulator" in fleet.manifest.services)
        try:
            serve(live, args.port)
        finally:
            live.disconnect()
    return 0


def _check_keys(robot: RobotConfig, *, must: bool) -> None:
    """Refuse keys by which no link comes; where nobody looks on, the services start and wait.

    Raises:
        BusError: they cannot be used now, and they must.
    """
    folder = keys_folder(robot)
    wrong = [f"{row.name}: {row.wrong}" for row in inspect_keys(folder, robot) if row.wrong]
    if not wrong:
        return
    more = f"; and {len(wrong) - 1} more, by `xrl keys check`" if len(wrong) > 1 else ""
    words = f"{folder}: {wrong[0]}{more}"
    if must:
        raise BusError(words)
    print(f"xrl: no link over TLS: {words}", file=sys.stderr)


def _make_record_folder(out: Path, *, must: bool) -> None:
    """Make the folder of the record; where nobody looks on, a robot starts without it.

    Raises:
        RunError: it cannot be made, and it must.
    """
    try:
        make_out(out, "up")
    except RunError as error:
        if must:
            raise
        print(f"xrl: not recorded: {error}", file=sys.stderr)


def _overrides(args: argparse.Namespace, out: Path) -> dict[str, list[str]]:
    """Return the arguments that the flags add to the services' own."""
    overrides = {"recorder": ["--out", str(out.absolute())]}
    if args.controller is not None:
        overrides["planner"] = ["--controller", absolute(args.controller)]
        overrides["recorder"] += [
            "--attach",
            f"{ATTACHED}={split_spec(args.controller)[0].absolute()}",
        ]
    if args.snapshot is not None:
        overrides["recorder"] += ["--snapshot", f"{args.snapshot:g}"]
    if HOST_RECORDER in (args.only or ()):
        overrides[HOST_RECORDER] = [*overrides["recorder"], "--of", _of_host(args.only)]
    if args.readonly:
        overrides |= {module: ["--readonly"] for module in MODULES}
    if args.scenario is not None:
        path = str(scenario_file(args.scenario, args.config))
        overrides["simulator"] = ["--scenario", path, "--autostart", str(SETTLE_S)]
        overrides["recorder"] += ["--scenario", path, "--scenario-text", args.scenario]
    if args.plant:
        plant_from(args.plant)  # refused before anything is started
        words = [word for given in args.plant for word in ("--plant", _absolute(given))]
        overrides["simulator"] = [*overrides.get("simulator", []), *words]
    return overrides


def _ros2_words(args: argparse.Namespace, robot: RobotConfig) -> list[str]:
    """Return the gateway's arguments.

    Raises:
        BusError, FleetError: ROS 2 may act, and this host has no key for that.
    """
    words = ["--simulated"] if is_simulated(robot) and not args.no_sim else []
    if args.domain is not None:
        words += ["--domain", str(args.domain)]
    if args.accept:
        require_operator(robot, "ros2_gateway")
        words += ["--accept", ",".join(args.accept)]
    return words


def _services(args: argparse.Namespace) -> tuple[str, ...] | None:
    """Return what `--only` names, None for all, if it goes with the other arguments.

    Raises:
        FleetError: an argument is for a service that is not started.
    """
    only: tuple[str, ...] | None = args.only
    absent = {"simulator"} if args.no_sim else set()
    if only is not None:
        if not only:
            raise FleetError("--only names no service; --only planner,harness,recorder, say")
        check_known(only, [row.name for row in load_table().process])
        if HOST_RECORDER in only and ("recorder" in only or not _of_host(only)):
            raise FleetError(
                f"{HOST_RECORDER} is for a host without the recorder, beside services of its own; "
                "name those, and leave the recorder"
            )
        absent |= {"simulator", "recorder", "planner", *MODULES} - set(only)
        if HOST_RECORDER in only:
            absent.discard("recorder")  # what is for one recorder is for the other
    for option, is_given, service in (
        ("--scenario", args.scenario is not None, "simulator"),
        ("--plant", bool(args.plant), "simulator"),
        ("--snapshot", args.snapshot is not None, "recorder"),
        ("--injectable", args.injectable, "planner"),
        ("--controller", args.controller is not None, "planner"),
    ):
        if is_given and service in absent:
            why = "--no-sim" if only is None or service in only else "--only"
            raise FleetError(f"{option} is for the {service}, and {why} starts none; leave one")
    for option, given in (("--domain", args.domain), ("--accept", args.accept)):
        if given is not None and not args.ros2:
            raise FleetError(f"{option} is for the gateway to ROS 2: add --ros2")
    if only is None:
        return None
    beside = {"network_proxy": args.injectable, "ros2_gateway": args.ros2}
    return (*only, *(name for name, wanted in beside.items() if wanted))


def _of_host(only: tuple[str, ...] | None) -> str:
    """Return what a host's own recorder records: the services that run beside it."""
    return ",".join(name for name in only or () if name in SERVICES)


def _absolute(word: str) -> str:
    """Return a word of `--plant`; a file's path as it is from anywhere."""
    return str(Path(word).absolute()) if word.endswith(".toml") and "=" not in word else word


def _names(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
