"""Selects the processes of the fleet, and checks whether they can start here.

The table is `deploy/processes.toml`; `tools.fleet.supervise` runs what this file selects.
"""

from __future__ import annotations

import errno
import os
import socket
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec

from shared.bus import security
from shared.bus.topics import TOPICS
from shared.config.endpoints import RUN, filled, host_and_port, stray_braces
from shared.config.files import load
from shared.config.robot_config import RobotConfig, expand
from shared.exceptions import ConfigError, FleetError
from shared.extras import EXTRAS, require
from shared.joints import MODULES
from shared.links import PAIRS, endpoint_through
from shared.network.proxy_protocol import SOCKET
from shared.places import FILES
from shared.process import SOCKET_PATH_MAX
from shared.run_directory import live_dir
from shared.toml_file import Range, Section, read_toml

TABLE = FILES / "processes.toml"
"""The process table of this checkout."""

PYTHON, CONFIG, MODULE = "{python}", "{config}", "{module}"
"""Placeholders of the table, besides that of the run directory."""

SIMULATED_CAN = "xrl_unix"
"""python-can interface of the emulated drives; it marks a simulated robot."""

SUPERVISOR_SOCKET = "supervisor.sock"
"""Name of the supervisor's own socket in the live directory."""

UNIX = "unixsock-stream/"
"""Prefix of a bus endpoint on a UNIX socket."""
_ELSEWHERE = "an address of another host (`--only` starts only the services of this host)"


class Process(Section, frozen=True):
    """One row of the table."""

    name: str
    """Service name, or `{module}` for one service per module."""
    kind: Literal[
        "joint",
        "planner",
        "harness",
        "imu",
        "recorder",
        "simulator",
        "network_proxy",
        "ros2_gateway",
    ]
    command: tuple[str, ...]
    """Arguments with the placeholders {python}, {config}, {run} and {module}."""
    autostart: bool
    ready: Literal["endpoint", "running"]
    """Ready once it listens on its bus endpoint, or once it has run for `settle_s`."""
    stop_signal: Literal["TERM", "INT"]
    stop_s: Annotated[int, Range(1, 60, "s")]
    """Time from the stop signal to SIGKILL."""
    settle_s: Annotated[int, Range(1, 60, "s")]
    """A process that ends sooner counts as a failed start, and its next start is delayed."""
    why: str
    only: Literal["", "simulation", "injected", "imu", "ros2", "named"] = ""
    """Condition of its start. `simulation`: emulated drives; `injected`: the network can be
    impaired; `imu`: an IMU is fitted; `ros2`: ROS 2 is requested; `named`: this service is
    requested by name."""
    extra: str = ""
    """Extra of pyproject.toml with the packages that it needs."""
    topic: str = ""
    """Topic that it publishes steadily, as in `shared.bus.topics`, or an empty string."""


class _ProcessTable(Section, frozen=True):
    """The whole process table."""

    environment: dict[str, str]
    """Environment variables of every process."""
    process: tuple[Process, ...]


class ListenPoint(NamedTuple):
    """An endpoint that a service of the fleet will listen on."""

    service: str
    key: str
    """Its key in the robot file."""
    endpoint: str
    """In Zenoh's notation: unixsock-stream/PATH or tcp/HOST:PORT."""


class FleetOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a fleet's start, besides its robot file and its run directory."""

    services: Collection[str] | None = None
    """Services to start, even without `autostart`; None for all that start by default."""
    not_started: Collection[str] = ()
    """Services that wait for `SupervisedFleet.start_service`."""
    overrides: Mapping[str, Sequence[str]] = {}
    """Additional arguments of some services."""
    no_restart: Collection[str] = ()
    """Services that stay down when they end."""
    simulation: bool = True
    """False leaves the simulator out; it is always left out where all drives are real."""
    injected: bool = False
    """Route the links of planner, joints and sensors through the network proxy."""
    ros2: bool = False
    """Start the gateway to ROS 2."""
    pace: float | None = None
    """Clock rate of a simulated fleet; None: `usual_pace` if it is simulated, else 1."""
    leashed: bool = False
    """Stop the fleet if this process or the supervisor dies."""
    disarmed: bool = False
    """Start without a person's request: arm no drive, take over holding drives, and keep an
    emergency stop and the logs of ended services. If a service fails to start, the others are not
    ended, since that would idle their drives; the supervisor keeps trying."""
    table_path: Path = TABLE
    timeout_s: float = 30.0
    """Timeout of a start that makes no progress, s; with progress it is `supervise.START_MAX_S`."""


class FleetPlan(NamedTuple):
    """A fleet before its start."""

    config_path: Path
    """The robot file, absolute."""
    options: FleetOptions
    processes: tuple[Process, ...]
    commands: dict[str, list[str]]
    """Command line of each service, with placeholders filled in."""
    listeners: tuple[ListenPoint, ...]
    environment: dict[str, str]
    emulated_usb: bool = False
    """True if the services find emulated drives on USB."""


def make_plan(config_path: Path, run_dir: Path, options: FleetOptions) -> FleetPlan:
    """Return the processes to start; refuse a fleet that cannot start here."""
    path = Path(os.path.abspath(config_path))  # noqa: PTH100 - symlinks stay as they were given
    config = load(path)
    table = load_table(options.table_path)
    rows = _selected(table, config, options)
    if any(row.name == "simulator" for row in rows):
        refuse_half_emulated(config)
    _check_lengths(run_dir, _listeners(table.process, config, run_dir))
    on_usb = config.joint_service.driver == "odrive_usb"
    for row in rows:
        for extra in (row.extra, "usb" if row.kind == "joint" and on_usb else ""):
            if extra:
                require(extra)
    through = {pair.dials for pair in PAIRS} if options.injected else set()
    values = {PYTHON: sys.executable, CONFIG: str(path), RUN: str(run_dir)}
    commands = {
        row.name: [
            *(filled(word, values) for word in row.command),
            *(["--injected"] if row.name in through else []),
            *options.overrides.get(row.name, ()),
        ]
        for row in rows
    }
    return FleetPlan(
        config_path=path,
        options=options,
        processes=rows,
        commands=commands,
        listeners=_listeners(rows, config, run_dir),
        environment=table.environment,
        emulated_usb=options.simulation and is_simulated(config) and on_usb,
    )


def _selected(
    table: _ProcessTable, config: RobotConfig, options: FleetOptions
) -> tuple[Process, ...]:
    """Return the rows of a fleet; refuse a name that the table or this fleet lacks."""
    services, named = options.services or (), options.services is not None
    check_known(services, [row.name for row in table.process])
    if "imu" in services and not config.imu.fitted:
        raise FleetError(
            "imu: this robot has no IMU (`fitted` of [imu] in the robot file); leave out imu, or "
            "correct the key"
        )
    if "ros2_gateway" in services and not options.ros2:
        raise FleetError("ros2_gateway: it starts only with --ros2; add --ros2")
    wanted = {
        "": True, "simulation": options.simulation and is_simulated(config), "named": named,
        "injected": options.injected, "imu": config.imu.fitted, "ros2": options.ros2,
    }  # fmt: skip
    rows = [
        row for row in table.process if wanted[row.only] and (row.name in services or not named)
    ]
    check_known([*options.overrides, *options.not_started], [row.name for row in rows])
    return tuple(
        msgspec.structs.replace(
            row, autostart=(named or row.autostart) and row.name not in options.not_started
        )
        for row in rows
    )


def load_table(path: Path = TABLE) -> _ProcessTable:
    """Read the process table with one row per service: a `{module}` row becomes six."""
    table = read_toml(path, _ProcessTable)
    rows: list[Process] = []
    for index, row in enumerate(table.process):
        if not row.command:
            raise ConfigError(
                str(path), f"process[{index}].command", "empty", "must name a program"
            )
        for key, value, known in (
            ("topic", row.topic, [topic.name for topic in TOPICS]),
            ("extra", row.extra, list(EXTRAS)),
        ):
            if value and value not in known:
                right = f"must be one of {', '.join(known)}"
                raise ConfigError(str(path), f"process[{index}].{key}", f"{value!r}", right)
        _check_placeholders(path, index, row)
        rows += [_of_module(row, module) for module in MODULES] if row.name == MODULE else [row]
    names = [row.name for row in rows]
    for name in names:
        if names.count(name) > 1:
            right = "must be listed once"
            raise ConfigError(str(path), "process", f"{name!r} is listed twice", right)
    return msgspec.structs.replace(table, process=tuple(rows))


def _check_placeholders(path: Path, index: int, row: Process) -> None:
    """Refuse a word in braces that is not a placeholder, because it would reach the program."""
    known = [PYTHON, CONFIG, RUN, *([MODULE] if row.name == MODULE else [])]
    texts = [("name", row.name, [MODULE]), *(("command", word, known) for word in row.command)]
    for key, text, placeholders in texts:
        stray = stray_braces(text, placeholders)
        if stray:
            found = f"{text!r}: {stray} is not a placeholder here"
            right = f"must be one of {', '.join(placeholders)}"
            raise ConfigError(str(path), f"process[{index}].{key}", found, right)


def _of_module(row: Process, module: str) -> Process:
    command = tuple(filled(word, {MODULE: module}) for word in row.command)
    return msgspec.structs.replace(row, name=module, command=command)


def is_simulated(config: RobotConfig) -> bool:
    """Return True if any drive of this robot file is emulated.

    The CAN buses in use decide, also for drives on USB. On a real robot all buses are real, or the
    fleet starts with `simulation=False` (`xrl up --no-sim`); then services search the real USB.
    """
    return any(config.can[name].interface == SIMULATED_CAN for name in config.buses)


def refuse_half_emulated(robot: RobotConfig) -> None:
    """Refuse a robot file that mixes emulated and real buses.

    With a single forgotten emulated bus, services would use emulated USB drives instead of the real
    ones, and no check would fail.
    """
    emulated = {name: robot.can[name].interface == SIMULATED_CAN for name in sorted(robot.buses)}
    if len(set(emulated.values())) > 1:
        some, real = (
            ", ".join(f"[can.{name}]" for name, is_so in emulated.items() if is_so == wanted)
            for wanted in (True, False)
        )
        raise FleetError(
            f"robot file: {some} {'are' if ',' in some else 'is'} emulated "
            f'(interface = "{SIMULATED_CAN}"), {real} {"are" if "," in real else "is"} not; make '
            "all of them real or all emulated, or start without the simulator: `xrl up --no-sim`"
        )


def check_known(names: Iterable[str], known: Collection[str]) -> None:
    """Refuse service names that are not among the known ones."""
    for name in names:
        if name not in known:
            raise FleetError(f"no service {name!r}; must be one of {', '.join(known)}")


def _listeners(
    processes: Iterable[Process], config: RobotConfig, run_dir: Path
) -> tuple[ListenPoint, ...]:
    """Return where these services will listen: bus endpoints, and the emulated drives' buses."""
    listeners = []
    here = security.services_here(config)
    for row in processes:
        if row.name in config.bus.endpoints:
            listeners += [
                ListenPoint(row.name, f"bus.endpoints.{row.name}", expand(endpoint, run_dir))
                for endpoint in security.listening(config, row.name, here)
            ]
        if row.kind == "network_proxy":
            endpoints = [expand(endpoint_through(pair), run_dir) for pair in PAIRS]
            endpoints.append(f"{UNIX}{live_dir(run_dir) / SOCKET}")
            listeners += [ListenPoint(row.name, "(the run directory)", at) for at in endpoints]
        if row.kind == "simulator":
            listeners += [
                ListenPoint(row.name, f"can.{name}.channel", UNIX + expand(bus.channel, run_dir))
                for name, bus in config.can.items()
                if bus.interface == SIMULATED_CAN
            ]
    return tuple(listeners)


def _check_lengths(run_dir: Path, listeners: Iterable[ListenPoint]) -> None:
    """Refuse a run directory whose path is too long for its UNIX sockets."""
    paths = [at.endpoint.removeprefix(UNIX) for at in listeners if at.endpoint.startswith(UNIX)]
    # supervisord first binds NAME.PID, then renames it
    paths.append(f"{live_dir(run_dir) / SUPERVISOR_SOCKET}.4194304")
    excess = max(len(os.fsencode(path)) for path in paths) - SOCKET_PATH_MAX
    if excess > 0:
        raise FleetError(
            f"{run_dir}: the paths of its sockets would be {excess} B too long; "
            "choose a shorter run directory with --run-dir"
        )


def check_free(listeners: Iterable[ListenPoint]) -> None:
    """Refuse endpoints that another process listens on."""
    for service, key, endpoint in listeners:
        if endpoint.startswith(UNIX):
            fault = "in use" if is_listening(endpoint) else ""
        else:
            fault = _tcp_fault(endpoint)
        if fault:
            stop = "stop the process that uses it, or " if fault.endswith("in use") else ""
            change = f"change {key} in the robot file" if "." in key else "choose another --run-dir"
            raise FleetError(f"{service}: {endpoint}: {fault}; {stop}{change}")


def is_elsewhere(endpoint: str) -> bool:
    """Return True if the endpoint belongs to a service on another host."""
    return not endpoint.startswith(UNIX) and _tcp_fault(endpoint) == _ELSEWHERE


def is_listening(endpoint: str) -> bool:
    """Return True if a process listens on a bus endpoint."""
    address: str | tuple[str, int]
    if endpoint.startswith(UNIX):
        family, address = socket.AF_UNIX, endpoint.removeprefix(UNIX)
    else:
        address = host_and_port(endpoint)
        family = _family_of(address[0])
    with socket.socket(family) as probe:
        probe.settimeout(0.5)
        try:
            probe.connect(address)
        except BlockingIOError:
            return True  # its backlog is full: it listens, but slowly
        except OSError:
            return False
    return True


def _tcp_fault(endpoint: str) -> str:
    """Return why a service cannot listen there, or an empty string."""
    host, port = host_and_port(endpoint)
    with socket.socket(_family_of(host)) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return "port in use"
            if error.errno == errno.EADDRNOTAVAIL:
                return _ELSEWHERE
            return f"cannot listen: {error.strerror or error}"
    return ""


def _family_of(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET
