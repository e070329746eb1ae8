"""`xrl up`: start the fleet."""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import Annotated, Final

from services.planner.controller import ATTACHED, absolute, controller_maker, split_spec
from services.ros2_gateway import rmw
from services.ros2_gateway.inbound import acceptable
from services.simulator.physics.plant import plant_from
from shared.bus.credentials import keys_folder, require_operator
from shared.bus.topics import HOST_RECORDER
from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import BusError, FleetError, RunError
from shared.joints import MODULES
from tools.flags import Arg, ConfigFlags, Folder, RunDirFlags, names_of, parsed
from tools.fleet.fleet_status import OPEN
from tools.fleet.pace import PaceFlags
from tools.fleet.process_table import FleetOptions, check_known, is_simulated, load_table
from tools.fleet.status_table import warn_of_others
from tools.fleet.supervise import SupervisedFleet
from tools.keys.inspection import inspect_keys
from tools.live.experiment import (
    ControllerFlags,
    PlantFlags,
    make_out,
    record_of_start,
    scenario_file,
)
from tools.terminal import Console, marked

SETTLE_S = 3.0
"""A scenario starts so long after the hoist is down."""


EXAMPLES: Final = """
xrl up
xrl up --scenario crawl --out out/crawl
xrl up --ros2                                  # ROS 2 sees it: docs/ros2.md
xrl up --ros2 --domain 7 --accept estop        # and may stop it
xrl up --injectable                            # then: xrl inject 'all delay=30'
xrl up --config lab.toml --no-sim
xrl up --config lab.toml --no-sim --only ankle_left,knee_left,hip_left  # one host's services
xrl up --config lab.toml --no-sim --only hip_left,host_recorder         # with a record on this host
xrl up --config lab.toml --no-sim --disarmed   # from a systemd unit
xrl up --config lab.toml --no-sim --readonly   # to move the joints by hand and watch
"""


class UpFlags(ConfigFlags, RunDirFlags, PlantFlags, ControllerFlags, PaceFlags):
    """Which services are started, and how."""

    out: Folder | None = None
    """where the recorder writes (default: out/ and the time)"""
    scenario: Annotated[str | None, Arg(metavar="NAME|FILE")] = None
    """what the simulated operator does once the robot stands: a file, or a name
    (beside the robot file in scenarios/, or a shipped one; its kills are left to you)"""
    no_sim: bool = False
    """start no simulator: the drives are real, or start later"""
    only: Annotated[
        tuple[str, ...] | None,
        parsed(names_of(), "SERVICE,...", is_one=True),
    ] = None
    """start only these: the other services run on other hosts, at their endpoints in the robot
    file"""
    no_planner: bool = False
    """start no planner: the six modules HOLD; `xrl start planner` starts it later"""
    injectable: bool = False
    """put the network proxy between planner, joints and sensors, for `xrl inject`"""
    disarmed: bool = False
    """arm no drive until a person asks (xrl kill MODULE), but take over drives that hold; for
    automatic starts, as after a power cut"""
    ros2: bool = False
    """show the robot to ROS 2 over Zenoh: joint states, transforms, diagnostics (docs/ros2.md)"""
    domain: Annotated[int | None, parsed(rmw.domain, "N")] = None
    """with --ros2: its domain (default: $ROS_DOMAIN_ID, else 0)"""
    accept: Annotated[tuple[str, ...] | None, parsed(acceptable, "TOPICS", is_one=True)] = None
    """with --ros2: let ROS 2 ask for assist (intent), stop the robot (estop), or both
    (intent,estop)"""
    readonly: bool = False
    """the joint services read their drives and publish, and send the drives nothing"""

    def check(self) -> None:
        """Refuse what is for a service that is not started."""
        super().check()
        only = self.only
        absent = {"simulator"} if self.no_sim else set()
        if only is not None:
            if not only:
                raise FleetError(
                    "--only names no service; for example --only planner,harness,recorder"
                )
            check_known(only, [row.name for row in load_table().process])
            if HOST_RECORDER in only and ("recorder" in only or not _of_host(only)):
                raise FleetError(
                    f"{HOST_RECORDER} is for a host without the recorder, beside services of its "
                    "own; name those, and leave the recorder"
                )
            absent |= {"simulator", "recorder", "planner", *MODULES} - set(only)
            if HOST_RECORDER in only:
                absent.discard("recorder")  # what is for one recorder is for the other
        for option, is_given, service in (
            ("--scenario", self.scenario is not None, "simulator"),
            ("--plant", bool(self.plant), "simulator"),
            ("--injectable", self.injectable, "planner"),
            ("--controller", self.controller is not None, "planner"),
        ):
            if is_given and service in absent:
                why = "--no-sim" if only is None or service in only else "--only"
                raise FleetError(f"{option} is for the {service}, and {why} starts none; leave one")
        for option, given in (("--domain", self.domain), ("--accept", self.accept)):
            if given is not None and not self.ros2:
                raise FleetError(f"{option} is for the gateway to ROS 2: add --ros2")

    @property
    def services(self) -> tuple[str, ...] | None:
        """What is started; None for all."""
        if self.only is None:
            return None
        beside = {"network_proxy": self.injectable, "ros2_gateway": self.ros2}
        return (*self.only, *(name for name, wanted in beside.items() if wanted))


def run(flags: UpFlags) -> int:
    """Start the fleet and say where it is."""
    robot = config_file.load(flags.config)
    gain_schedule.require(robot, flags.config)
    if robot.bus.security.mode == "mtls":
        _check_keys(robot, must=not flags.disarmed)
    services = flags.services
    out = flags.out or Path("out") / time.strftime("%Y%m%d-%H%M%S")
    if flags.controller is not None:
        controller_maker(flags.controller, robot)  # refused before anything is started
    overrides = _overrides(flags, out)
    if flags.ros2:
        overrides["ros2_gateway"] = _ros2_words(flags, robot)
    if services is not None:
        overrides = {name: words for name, words in overrides.items() if name in services}
    recorders, made = {"recorder", HOST_RECORDER}, not out.exists()
    if services is None or recorders & set(services):
        _make_record_folder(out, must=not flags.disarmed)
    not_started = flags.no_planner and (services is None or "planner" in services)
    options = FleetOptions(
        overrides=overrides,
        services=services,
        not_started=("planner",) if not_started else (),
        simulation=not flags.no_sim,
        injected=flags.injectable,
        ros2=flags.ros2,
        pace=flags.pace,
        disarmed=flags.disarmed,
    )
    try:
        with record_of_start(out):
            fleet = SupervisedFleet.start(flags.config, flags.run_dir, options)
    except BaseException:
        if made:
            with contextlib.suppress(OSError):  # it has a record, or was never made
                out.rmdir()
        raise
    warn_of_others(Console(), own=fleet.run.path)
    up = len(fleet.manifest.services) - not_started
    record = f", record: {out}" if recorders & set(fleet.manifest.services) else ""
    print(
        f"{up} service{'s are' if up != 1 else ' is'} up in {fleet.run.path} "
        f"(logs: {fleet.run.logs}{record}); `xrl status` shows them, `xrl down` stops them"
    )
    if robot.bus.security.mode == "open":
        Console().print(marked("[bold red]{}[/]", OPEN))
    return 0


def _check_keys(robot: RobotConfig, *, must: bool) -> None:
    """Refuse keys by which no link comes; where nobody looks on, the services start and wait."""
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
    """Make the folder of the record; where nobody looks on, a robot starts without it."""
    try:
        make_out(out, "up")
    except RunError as error:
        if must:
            raise
        print(f"xrl: not recorded: {error}", file=sys.stderr)


def _overrides(flags: UpFlags, out: Path) -> dict[str, list[str]]:
    """Return the arguments that the flags add to the services' own."""
    overrides = {"recorder": ["--out", str(out.absolute())]}
    if flags.controller is not None:
        overrides["planner"] = ["--controller", absolute(flags.controller)]
        overrides["recorder"] += [
            "--attach",
            f"{ATTACHED}={split_spec(flags.controller)[0].absolute()}",
        ]
    if HOST_RECORDER in (flags.only or ()):
        overrides[HOST_RECORDER] = [*overrides["recorder"], "--of", _of_host(flags.only)]
    if flags.readonly:
        overrides |= {module: ["--readonly"] for module in MODULES}
    if flags.scenario is not None:
        path = str(scenario_file(flags.scenario, flags.config))
        overrides["simulator"] = ["--scenario", path, "--autostart", str(SETTLE_S)]
        overrides["recorder"] += ["--scenario", path, "--scenario-text", flags.scenario]
    if flags.plant:
        plant_from(flags.plant)  # refused before anything is started
        words = [word for given in flags.plant for word in ("--plant", _absolute(given))]
        overrides["simulator"] = [*overrides.get("simulator", []), *words]
    return overrides


def _ros2_words(flags: UpFlags, robot: RobotConfig) -> list[str]:
    """Return the gateway's arguments."""
    words = ["--simulated"] if is_simulated(robot) and not flags.no_sim else []
    if flags.domain is not None:
        words += ["--domain", str(flags.domain)]
    if flags.accept:
        require_operator(robot, "ros2_gateway")
        words += ["--accept", ",".join(flags.accept)]
    return words


def _of_host(only: tuple[str, ...] | None) -> str:
    """Return what a host's own recorder records: the services that run beside it."""
    return ",".join(name for name in only or () if name in SERVICES)


def _absolute(word: str) -> str:
    """Return a word of `--plant`; a file's path as it is from anywhere."""
    return str(Path(word).absolute()) if word.endswith(".toml") and "=" not in word else word
