"""Which processes make up the fleet, and whether they can be started here.

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
from shared.toml_file import Range, Section, read_toml

TABLE = FILES / "processes.toml"
"""The process table of this checkout."""

PYTHON, CONFIG, MODULE = "{python}", "{config}", "{module}"
"""Placeholders of the table, beside that of the run directory."""

SIMULATED_CAN = "xrl_unix"
"""python-can interface of the emulated drives: the robot is a simulated one."""

SUPERVISOR_SOCKET = "supervisor.sock"
"""Name of the supervisor's own socket in the run directory."""

UNIX = "unixsock-stream/"
"""Prefix of a bus endpoint on a UNIX socket."""
_ELSEWHERE = "an address of another host (`--only` starts the services of this one)"


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
    """Up once it listens on its bus endpoint, or once it has lived for `settle_s`."""
    stop_signal: Literal["TERM", "INT"]
    stop_s: Annotated[int, Range(1, 60, "s")]
    """Time from the stop signal to SIGKILL."""
    settle_s: Annotated[int, Range(1, 60, "s")]
    """A start that ends sooner has failed, and the next one is delayed."""
    why: str
    only: Literal["", "simulation", "injected", "imu", "ros2", "named"] = ""
    """`simulation`: not started where the drives are real; `injected`: only where the network is
    to be impaired; `imu`: only on a robot that has one; `ros2`: only where ROS 2 is to see it;
    `named`: only where it is asked for by name."""
    extra: str = ""
    """Extra of pyproject.toml whose packages it needs."""
    topic: str = ""
    """Topic that it publishes steadily, as in `shared.bus.topics`; empty if there is none."""


class ProcessTable(Section, frozen=True):
    """The whole process table."""

    environment: dict[str, str]
    """Environment variables of every process."""
    process: tuple[Process, ...]


class ListenPoint(NamedTuple):
    """An endpoint that a service of the fleet will listen on."""

    service: str
    key: str
    """Where it stands in the robot file."""
    endpoint: str
    """As Zenoh writes it: unixsock-stream/PATH or tcp/HOST:PORT."""


class FleetPlan(NamedTuple):
    """A fleet that is to be started."""

    config_path: Path
    """The robot file, absolute."""
    processes: tuple[Process, ...]
    commands: dict[str, list[str]]
    """Arguments of each service, placeholders filled in."""
    listeners: tuple[ListenPoint, ...]
    environment: dict[str, str]
    emulated_usb: bool = False
    """The services look for their drives on USB, and find emulated ones there."""


def make_plan(
    config_path: Path,
    run_dir: Path,
    *,
    overrides: Mapping[str, Sequence[str]],
    services: Collection[str] | None,
    not_started: Collection[str] = (),
    simulation: bool,
    injected: bool = False,
    ros2: bool = False,
    table_path: Path,
) -> FleetPlan:
    """Return the processes to start; arguments as for `SupervisedFleet.start`.

    Raises:
        ConfigError: the robot file or the table cannot be used.
        FleetError: a service is unknown, or the run directory's path is too long.
        MissingPackageError: a service needs a package that is not installed.
    """
    path = Path(os.path.abspath(config_path))  # noqa: PTH100 - symlinks stay as they were given
    config = load(path)
    table = load_table(table_path)
    emulated = simulation and is_simulated(config)
    rows = select(
        table, simulation=emulated, injected=injected, imu=config.imu.fitted, ros2=ros2,
        services=services,
    )  # fmt: skip
    check_known([*overrides, *not_started], [row.name for row in rows])
    rows = tuple(
        msgspec.structs.replace(row, autostart=row.autostart and row.name not in not_started)
        for row in rows
    )
    check_run_dir(run_dir, config)
    _require_packages(rows, config)
    through = {pair.dials for pair in PAIRS} if injected else set()
    commands = {
        row.name: [
            *command_of(row, path, run_dir),
            *(["--injected"] if row.name in through else []),
            *overrides.get(row.name, ()),
        ]
        for row in rows
    }
    listeners = listeners_of(rows, config, run_dir)
    usb = emulated and config.joint_service.driver == "odrive_usb"
    return FleetPlan(path, rows, commands, listeners, table.environment, emulated_usb=usb)


def _require_packages(rows: Iterable[Process], config: RobotConfig) -> None:
    """Make sure that each service has its packages."""
    for row in rows:
        if row.extra:
            require(row.extra)
        if row.kind == "joint" and config.joint_service.driver == "odrive_usb":
            require("usb")


def load_table(path: Path = TABLE) -> ProcessTable:
    """Read the process table, with one row for each service: `{module}` rows are six.

    Raises:
        ConfigError: the table cannot be read, or a service stands in it twice.
    """
    table = read_toml(path, ProcessTable)
    topics = [topic.name for topic in TOPICS]
    rows: list[Process] = []
    for index, row in enumerate(table.process):
        if not row.command:
            raise ConfigError(str(path), f"process[{index}].command", "empty", "a program to run")
        if row.topic and row.topic not in topics:
            right = f"one of {', '.join(topics)}"
            raise ConfigError(str(path), f"process[{index}].topic", f"{row.topic!r}", right)
        if row.extra and row.extra not in EXTRAS:
            right = f"one of {', '.join(EXTRAS)}"
            raise ConfigError(str(path), f"process[{index}].extra", f"{row.extra!r}", right)
        _check_placeholders(path, index, row)
        rows += _for_each_module(row) if row.name == MODULE else [row]
    names = [row.name for row in rows]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(str(path), "process", f"{name!r} stands twice", "each service once")
    return msgspec.structs.replace(table, process=tuple(rows))


def _check_placeholders(path: Path, index: int, row: Process) -> None:
    """Refuse what stands in braces and would reach a program as it is."""
    known = [PYTHON, CONFIG, RUN, *([MODULE] if row.name == MODULE else [])]
    texts = [("name", row.name, [MODULE]), *(("command", word, known) for word in row.command)]
    for key, text, placeholders in texts:
        stray = stray_braces(text, placeholders)
        if stray:
            found = f"{text!r}: {stray} is no placeholder here"
            right = f"one of {', '.join(placeholders)}"
            raise ConfigError(str(path), f"process[{index}].{key}", found, right)


def is_simulated(config: RobotConfig) -> bool:
    """Return True if any drive of this robot file is an emulated one.

    The CAN buses in use say so, also of drives on USB: all of a real robot's are real ones, or it
    is started with `simulation=False` (`xrl up --no-sim`). Then a service looks on the real USB.
    """
    return any(config.can[name].interface == SIMULATED_CAN for name in config.buses)


def select(
    table: ProcessTable,
    *,
    simulation: bool,
    injected: bool = False,
    imu: bool = False,
    ros2: bool = False,
    services: Collection[str] | None = None,
) -> tuple[Process, ...]:
    """Return the rows of a fleet.

    Args:
        table: from `load_table`.
        simulation: False leaves out the rows that are for a simulated robot only.
        injected: False leaves out those that impair the network.
        imu: False leaves out those of the IMU.
        ros2: False leaves out the gateway to ROS 2.
        services: names; each is then started at once, whatever its row says. None for all.

    Raises:
        FleetError: a name is not in the table, or of what this fleet is not to have.
    """
    check_known(services or (), [row.name for row in table.process])
    if "imu" in (services or ()) and not imu:
        raise FleetError("imu: this robot has none; `fitted` of [imu] in the robot file says so")
    if "ros2_gateway" in (services or ()) and not ros2:
        raise FleetError("ros2_gateway: it is started with --ros2; add that")
    wanted = {
        "": True, "simulation": simulation, "injected": injected, "imu": imu, "ros2": ros2,
        "named": services is not None,
    }  # fmt: skip
    rows = [row for row in table.process if wanted[row.only]]
    if services is None:
        return tuple(rows)
    return tuple(
        msgspec.structs.replace(row, autostart=True) for row in rows if row.name in services
    )


def check_known(names: Iterable[str], known: Collection[str]) -> None:
    """Refuse service names that are not among the known ones.

    Raises:
        FleetError: naming the first one, and all that are known.
    """
    for name in names:
        if name not in known:
            raise FleetError(f"no service {name!r}; one of {', '.join(known)}")


def command_of(process: Process, config_path: Path, run_dir: Path) -> list[str]:
    """Return a row's command with its placeholders filled in."""
    values = {PYTHON: sys.executable, CONFIG: str(config_path), RUN: str(run_dir)}
    return [filled(word, values) for word in process.command]


def listeners_of(
    processes: Iterable[Process], config: RobotConfig, run_dir: Path
) -> tuple[ListenPoint, ...]:
    """Return where these services will listen: on the bus, and the emulated drives' buses."""
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
            endpoints.append(f"{UNIX}{run_dir / SOCKET}")
            listeners += [ListenPoint(row.name, "(the run directory)", at) for at in endpoints]
        if row.kind == "simulator":
            listeners += [
                ListenPoint(row.name, f"can.{name}.channel", UNIX + expand(bus.channel, run_dir))
                for name, bus in config.can.items()
                if bus.interface == SIMULATED_CAN
            ]
    return tuple(listeners)


def check_run_dir(run_dir: Path, config: RobotConfig) -> None:
    """Refuse a run directory that is too long for the fleet's UNIX sockets.

    Raises:
        FleetError: naming the longest socket path.
    """
    here = security.services_here(config)
    endpoints = [security.endpoint_here(config, name, here) for name in config.bus.endpoints]
    paths = [expand(at.removeprefix(UNIX), run_dir) for at in endpoints if at.startswith(UNIX)]
    paths += [
        expand(bus.channel, run_dir)
        for bus in config.can.values()
        if bus.interface == SIMULATED_CAN
    ]
    paths += [expand(endpoint_through(pair), run_dir).removeprefix(UNIX) for pair in PAIRS]
    # supervisord binds NAME.PID first, and renames it
    paths.append(f"{run_dir / SUPERVISOR_SOCKET}.4194304")
    excess = max(len(os.fsencode(path)) for path in paths) - SOCKET_PATH_MAX
    if excess > 0:
        raise FleetError(
            f"{run_dir}: run directory too long by {excess} bytes for the paths of its sockets; "
            "give a shorter one with --run-dir"
        )


def check_free(listeners: Iterable[ListenPoint]) -> None:
    """Refuse endpoints that another process listens on.

    Raises:
        FleetError: naming the service and the endpoint.
    """
    for service, key, endpoint in listeners:
        if endpoint.startswith(UNIX):
            fault = "in use" if is_listening(endpoint) else ""
        else:
            fault = _tcp_fault(endpoint)
        if fault:
            raise FleetError(
                f"{service}: {endpoint}: {fault}; stop what uses it, or change {key} "
                "in the robot file"
            )


def is_elsewhere(endpoint: str) -> bool:
    """Return True for the endpoint of a service that runs on another host."""
    return not endpoint.startswith(UNIX) and _tcp_fault(endpoint) == _ELSEWHERE


def services_elsewhere(config: RobotConfig, run_dir: Path) -> tuple[str, ...]:
    """Return the services of a robot that run on other hosts than this."""
    return tuple(
        name
        for name, endpoint in config.bus.endpoints.items()
        if is_elsewhere(expand(endpoint, run_dir))
    )


def is_listening(endpoint: str) -> bool:
    """Return True if some process listens on a bus endpoint."""
    if endpoint.startswith(UNIX):
        return _accepts(socket.AF_UNIX, endpoint.removeprefix(UNIX))
    host, port = host_and_port(endpoint)
    return _accepts(socket.AF_INET6 if ":" in host else socket.AF_INET, (host, port))


def _for_each_module(row: Process) -> list[Process]:
    return [
        msgspec.structs.replace(
            row,
            name=module,
            command=tuple(filled(word, {MODULE: module}) for word in row.command),
        )
        for module in MODULES
    ]


def _tcp_fault(endpoint: str) -> str:
    """Return why a service could not listen there, or nothing."""
    host, port = host_and_port(endpoint)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return "port in use"
            if error.errno == errno.EADDRNOTAVAIL:
                return _ELSEWHERE
            return f"cannot be listened on: {error.strerror or error}"
    return ""


def _accepts(family: socket.AddressFamily, address: str | tuple[str, int]) -> bool:
    with socket.socket(family) as probe:
        probe.settimeout(0.5)
        try:
            probe.connect(address)
        except BlockingIOError:
            return True  # its backlog is full: it listens, and is slow
        except OSError:
            return False
    return True
