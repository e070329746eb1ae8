"""`xrl up`: starts the fleet."""

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
"""Delay between the end of the hoist's descent and the start of the scenario, s."""


EXAMPLES: Final = """
xrl up
xrl up --scenario crawl --out out/crawl
xrl up --ros2 --domain 7 --accept estop        # let ROS 2 stop the robot
xrl up --config lab.toml --no-sim
xrl up --config lab.toml --no-sim --only ankle_left,knee_left,hip_left  # one host's services
xrl up --config lab.toml --no-sim --only hip_left,host_recorder         # recorded on this host
xrl up --config lab.toml --no-sim --disarmed   # automatic start, from a systemd unit
xrl up --config lab.toml --no-sim --readonly   # to move the joints by hand and watch
"""


class UpFlags(ConfigFlags, RunDirFlags, PlantFlags, ControllerFlags, PaceFlags):
    """Services to start, and their options."""

    out: Folder | None = None
    """folder for the results (default: a new one in out/)"""
    scenario: Annotated[str | None, Arg(metavar="NAME|FILE")] = None
    """scenario for the simulated operator once the robot stands, as for `xrl demo`, but without its
    kills, restarts and impairments"""
    no_sim: bool = False
    """start no simulator: the drives are real, or a simulator starts later"""
    only: Annotated[
        tuple[str, ...] | None,
        parsed(names_of(), "SERVICE,...", is_one=True),
    ] = None
    """start only these services; others run on other hosts, at the robot file's endpoints"""
    no_planner: bool = False
    """start no planner, so all modules hold; `xrl start planner` starts it later"""
    injectable: bool = False
    """put the network proxy between planner, joints and sensors, for `xrl inject`"""
    disarmed: bool = False
    """arm no drive until a person requests it (`xrl kill MODULE`), but take over holding drives"""
    ros2: bool = False
    """publish joint states, transforms and diagnostics to ROS 2 over Zenoh (docs/ros2.md)"""
    domain: Annotated[int | None, parsed(rmw.domain, "N")] = None
    """ROS domain (default: $ROS_DOMAIN_ID, else 0)"""
    accept: Annotated[tuple[str, ...] | None, parsed(acceptable, "TOPICS", is_one=True)] = None
    """let ROS 2 request assist (intent), stop the robot (estop), or both
    (intent,estop)"""
    readonly: bool = False
    """let the joint services read and publish, but send the drives no commands"""

    def check(self) -> None:
        """Refuse flags of services that are not started."""
        super().check()
        only = self.only
        absent = {"simulator"} if self.no_sim else set()
        if only is not None:
            if not only:
                raise FleetError(
                    "--only names no service; give some, such as --only planner,harness,recorder"
                )
            check_known(only, [row.name for row in load_table().process])
            if HOST_RECORDER in only and ("recorder" in only or not _of_host(only)):
                raise FleetError(
                    f"--only: {HOST_RECORDER} is for a host that runs other services but not the "
                    "recorder; add those services, and remove recorder"
                )
            absent |= {"simulator", "recorder", "planner", *MODULES} - set(only)
            if HOST_RECORDER in only:
                absent.discard("recorder")  # both recorders have the same flags
        for option, is_given, service in (
            ("--scenario", self.scenario is not None, "simulator"),
            ("--plant", bool(self.plant), "simulator"),
            ("--injectable", self.injectable, "planner"),
            ("--controller", self.controller is not None, "planner"),
        ):
            if is_given and service in absent:
                why = "--no-sim" if only is None or service in only else "--only"
                raise FleetError(
                    f"{option} needs the {service}, which {why} leaves out; remove one of the two"
                )
        for option, given in (("--domain", self.domain), ("--accept", self.accept)):
            if given is not None and not self.ros2:
                raise FleetError(f"{option} needs the gateway to ROS 2; add --ros2")

    @property
    def services(self) -> tuple[str, ...] | None:
        """Services to start; None for all."""
        if self.only is None:
            return None
        beside = {"network_proxy": self.injectable, "ros2_gateway": self.ros2}
        return (*self.only, *(name for name, wanted in beside.items() if wanted))


def run(flags: UpFlags) -> int:
    """Start the fleet and print its run directory."""
    robot = config_file.load(flags.config)
    gain_schedule.require(robot, flags.config)
    if robot.bus.security.mode == "mtls":
        _check_keys(robot, must=not flags.disarmed)
    services = flags.services
    out = flags.out or Path("out") / time.strftime("%Y%m%d-%H%M%S")
    if flags.controller is not None:
        controller_maker(flags.controller, robot)  # reject it before anything is started
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
            with contextlib.suppress(OSError):  # it holds a record, or was never created
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
    """Refuse unusable keys; on an automatic start, print a warning instead."""
    folder = keys_folder(robot)
    wrong = [f"{row.name}: {row.wrong}" for row in inspect_keys(folder, robot) if row.wrong]
    if not wrong:
        return
    more = f"; and {len(wrong) - 1} more: see `xrl keys check`" if len(wrong) > 1 else ""
    words = f"{folder}: {wrong[0]}{more}"
    if must:
        raise BusError(words)
    print(f"xrl: links over TLS will fail: {words}", file=sys.stderr)


def _make_record_folder(out: Path, *, must: bool) -> None:
    """Create the record's folder; on an automatic start, print a warning if that fails."""
    try:
        make_out(out, "up")
    except RunError as error:
        if must:
            raise
        print(f"xrl: not recorded: {error}", file=sys.stderr)


def _overrides(flags: UpFlags, out: Path) -> dict[str, list[str]]:
    """Return each service's additional arguments."""
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
        plant_from(flags.plant)  # reject invalid values before anything is started
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
    """Return the services that a host's own recorder records: those on the same host."""
    return ",".join(name for name in only or () if name in SERVICES)


def _absolute(word: str) -> str:
    """Return a word of `--plant`, with the path of a file made absolute."""
    return str(Path(word).absolute()) if word.endswith(".toml") and "=" not in word else word
