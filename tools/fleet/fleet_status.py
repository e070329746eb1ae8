"""Fleet status for `xrl status`: its services, its modules and the planner."""

from __future__ import annotations

import errno
import os
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import msgspec

from services.joint.rearm_guard import stop_source
from shared import scheduling
from shared.bus import security
from shared.bus.credentials import Credentials, read_credentials
from shared.bus.messages import (
    LOST_DRIVE,
    Cause,
    DriveStatus,
    JointState,
    Message,
    Mode,
    Outside,
    Pair,
    PlannerMode,
    PlannerStatus,
    Refusal,
    ToolRoster,
    name_of,
)
from shared.bus.pubsub import Latest
from shared.bus.security import TCP
from shared.bus.session import Session, peers_of, place_of_tool
from shared.bus.sockets import addresses_of
from shared.bus.tls_probe import own_fault, refusal
from shared.bus.topics import JOINT_STATE, PLANNER_STATUS, TOOLS, TOPICS
from shared.clock import NS_PER_S, now_ns, pace
from shared.config.endpoints import host_and_port
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import FELL_EXIT_CODE, BusError, FleetError
from shared.joints import MODULES
from shared.robot.trip_table import WEARING, reason_of, remedy_of
from tools.fleet import procfs
from tools.fleet.proxy_client import ProxyClient
from tools.fleet.run_dir import SPACE_LOW_MIB, free_mib_at
from tools.fleet.supervise import SupervisedFleet
from tools.fleet.supervisor_client import ServiceInfo

TIERS: Final = {Mode.TRACK: 1, Mode.HOLD: 2}
"""Tier that holds a module up: the planner (1) or its joint service alone (2). In every other
mode neither does, and the mode says why."""

PLANNER: Final = "planner"
ROSTER: Final = "tools"
"""Name of the monitor for the recorder's roster of tools; no service has this name."""
SILENT_PROXY: Final = "unknown: the network proxy does not answer"

OPEN: Final = "bus.security.mode is open: anyone who reaches its ports can command this robot"

_LINKS_S: Final = 1.0
"""Timeout for the first message of each service, s."""
_WINDOW_S: Final = 0.5
"""Window over which rates are counted, s."""
_FRESH_S: Final = 1.0
"""Age from which a message is stale, s: its sender is dead, suspended or cut off."""
_POLL_S: Final = 0.002
_PROBES_AT_ONCE: Final = 16


class ServiceStatus(ServiceInfo, frozen=True):
    """One service, as its supervisor and its messages show it."""

    age_s: float | None = None
    """Age of its newest message; None if none has arrived, or if it does not publish steadily."""
    rate_hz: float | None = None
    """Its messages per second, by their sequence numbers; None as for `age_s`."""
    real_time: bool | None = None
    """True if it has real-time priority; None if it does not run, or needs no such priority."""


class RefusedCommands(msgspec.Struct, frozen=True):
    """Commands of one sender that a module refuses for the same cause."""

    cause: str
    """Name of the `Refusal`."""
    session: int
    """Session of the planner that sends them; 0 if unknown, because they are malformed."""
    hz: float
    """Commands per second."""


class ModuleStatus(msgspec.Struct, frozen=True):
    """One module, by the newest state of its joint service."""

    mode: str | None = None
    """Name of its `Mode`; None if its joint service is silent."""
    tier: int | None = None
    """See `TIERS`; None in other modes."""
    cause: str | None = None
    """Name of the `Cause` of its last change of mode."""
    drive: str | None = None
    """Name of the `DriveStatus` of its drive."""
    q: Pair | None = None
    """(phi, theta), rad; None if its drive does not know them."""
    way_out: str = ""
    """Remedy that lets it track again; empty if none is needed."""
    stiffened: bool = False
    """True if its gains rise to the support gains, because another module may be limp."""
    outside: str = ""
    """Name of the refused part of the newest command (`Outside`); empty if it is accepted."""
    session: int = 0
    """Session of the planner whose commands it uses, or 0."""
    refusals: tuple[RefusedCommands, ...] = ()
    """Commands that it refuses now, by cause and sender."""
    stopped_by: str = ""
    """Person and host that requested the active emergency stop, if the service is on this host."""
    celsius: tuple[float, float] | None = None
    """Estimated temperature of both windings, C; None if not estimated."""
    heat_left_s: float | None = None
    """Seconds at this load until the module is too warm, 3600 for an hour or more; None if not
    estimated."""


class LeadStatus(msgspec.Struct, frozen=True):
    """The planner's state, from its newest status."""

    mode: str
    """Name of its `PlannerMode`."""
    wait_s: float
    """Remaining back-off until it may lead again after dropouts, s."""
    margin: float
    """Margin of the gains by the static certificate: 1 is the required stiffness."""
    why: str = ""
    """Reason why it does not lead, in words, if the mode does not explain it."""
    session: int = 0
    carried_n: float = 0.0
    """Weight of payload and person that the robot carries now, N, as in `PlannerStatus`."""
    wearer: str = ""
    """Wearer's state as estimated by the planner (`services.planner.watch.park`), in words; empty
    if the wearer leads."""


class FleetStatus(msgspec.Struct, frozen=True):
    """The output of `xrl status --json`."""

    run_dir: str
    config: str
    services: dict[str, ServiceStatus]
    modules: dict[str, ModuleStatus]
    lead: LeadStatus | None = None
    """None if no planner is sending its status."""
    network: tuple[str, ...] = ()
    """Active impairments of the network proxy, as text."""
    pace: float = 1.0
    """Rate of the fleet's clock; below 1 is slow motion."""
    security: str = "local"
    """`bus.security.mode` of the robot file."""
    tools: tuple[str, ...] = ()
    """Linked tools besides this process, each as NAME.HOST.PID."""
    trouble: tuple[str, ...] = ()
    """Faults of supervision, logs and disk, one line each."""
    bus_faults: tuple[str, ...] = ()
    """Under `mtls`: unusable certificates and links that TLS refuses, in words."""

    @property
    def exit_code(self) -> int:
        """`FELL_EXIT_CODE` if the planner reports that the robot has fallen, else 0."""
        fell = self.lead is not None and self.lead.mode == PlannerMode.FALLEN.name
        return FELL_EXIT_CODE if fell else 0


class RateMonitor:
    """Newest message of one service, its age, and its rates in the current window.

    The age counts from the arrival, because the stamp is on the sender's clock, which may be that
    of another host.
    """

    def __init__(self, latest: Latest[Message]) -> None:
        self._latest = latest
        self._first: Message | None = None
        self.newest: Message | None = None
        self._heard_ns = 0
        self._refused: Counter[tuple[int, int]] = Counter()

    def listen(self) -> None:
        """Receive new messages."""
        message = self._latest.take()
        if message is None:
            return
        restarted = self.newest is not None and message.seq < self.newest.seq
        if self._first is None or restarted:
            self._first = message
        elif isinstance(message, JointState) and isinstance(self.newest, JointState):
            cause = (message.refusal, message.refused_session)
            self._refused[cause] += max(0, message.refused - self.newest.refused)
        self.newest, self._heard_ns = message, now_ns()

    def new_window(self) -> None:
        """Start a new window for the rates."""
        self._first = self.newest
        self._refused.clear()

    def age_s(self) -> float | None:
        """Return the time since the newest message arrived."""
        return None if self.newest is None else (now_ns() - self._heard_ns) / NS_PER_S

    def is_fresh(self) -> bool:
        """Return True if the newest message is not stale."""
        age_s = self.age_s()
        return age_s is not None and age_s < _FRESH_S

    def refusals(self) -> tuple[RefusedCommands, ...]:
        """Return the commands refused in this window; empty for services other than joints."""
        first, newest = self._first, self.newest
        if first is None or newest is None or newest.t_ns <= first.t_ns:
            return ()
        per_s = NS_PER_S / (newest.t_ns - first.t_ns)
        return tuple(
            RefusedCommands(name_of(Refusal, cause), session, count * per_s)
            for (cause, session), count in self._refused.items()
            if count and cause
        )

    def rate_hz(self) -> float | None:
        """Return the messages per second in this window, 0 without a new one, None without any."""
        if self._first is None or self.newest is None:
            return None
        span_ns = self.newest.t_ns - self._first.t_ns
        return (self.newest.seq - self._first.seq) * NS_PER_S / span_ns if span_ns > 0 else 0.0


class BusFaults:
    """Checks the links that this host's services, and this tool, dial over TLS."""

    def __init__(self, robot: RobotConfig, session: Session) -> None:
        self._robot, self._session = robot, session
        self.mode = robot.bus.security.mode
        self._here = security.services_here(robot)

    def describe(self, pids: dict[str, int]) -> tuple[str, ...]:
        """Return the faults, in words; takes up to 2 s if a link does not answer."""
        if self.mode != "mtls":
            return ()
        links = list(self._missing(pids))
        with ThreadPoolExecutor(_PROBES_AT_ONCE) as pool:
            found = pool.map(lambda link: refusal(link[1], link[3]), links)
            refused = [
                f"no link {dials} -> {peer} ({endpoint}): {why}"
                for (dials, _, peer, endpoint), why in zip(links, found, strict=True)
                if why
            ]
        return (*self._own_faults(), *refused)

    def _own_faults(self) -> Iterator[str]:
        found: dict[str, list[str]] = {}
        for name in sorted(self._here):
            fault = own_fault(read_credentials(self._robot, name))
            if fault:
                found.setdefault(fault, []).append(name)
        for fault, names in found.items():
            yield f"no link over TLS: certificate of {', '.join(names)} {fault}"

    def _missing(self, pids: dict[str, int]) -> Iterator[tuple[str, Credentials, str, str]]:
        """Yield dialling process, its credentials, peer and endpoint of each missing link."""
        alive = self._session.alive()
        for dials, pid in (*pids.items(), (self._session.name, None)):
            if pid is not None and dials not in SERVICES:
                continue
            linked = set() if pid is None else procfs.connected(pid)
            for peer in peers_of(dials, self._robot.services):
                endpoint = security.endpoint_here(self._robot, peer, self._here)
                there = _is_in(endpoint, linked) if pid is not None else peer in alive
                if there or not endpoint.startswith(TCP):
                    continue
                try:
                    yield dials, read_credentials(self._robot, dials), peer, endpoint
                except BusError:  # the log of the service reports it
                    break


def _is_in(endpoint: str, linked: Collection[tuple[str, int]]) -> bool:
    if not endpoint.startswith(TCP):
        return True
    host, port = host_and_port(endpoint)
    return any((str(address), port) in linked for address in addresses_of(host))


def monitors_of(session: Session, topics: Mapping[str, str]) -> dict[str, RateMonitor]:
    """Return a monitor per service that publishes steadily; modules may be on other hosts."""
    elsewhere = dict.fromkeys(MODULES, JOINT_STATE.name) | {
        PLANNER: PLANNER_STATUS.name, ROSTER: TOOLS.name,
    }  # fmt: skip
    by_name = {topic.name: topic for topic in TOPICS}
    monitors = {}
    for service, name in (elsewhere | dict(topics)).items():
        if name:
            topic = by_name[name]
            module = service if topic.per_module else ""
            monitors[service] = RateMonitor(session.latest(topic, topic.type, module))
    return monitors


def listen_for_all(monitors: Mapping[str, RateMonitor]) -> None:
    """Wait for the first message of each service, with a short timeout."""
    _listen(monitors, _LINKS_S, until=lambda: all(monitor.newest for monitor in monitors.values()))


def read_status(
    fleet: SupervisedFleet, monitors: Mapping[str, RateMonitor], bus: BusFaults
) -> FleetStatus:
    """Listen for one window and return the fleet's status."""
    for monitor in monitors.values():
        monitor.new_window()
    _listen(monitors, _WINDOW_S)
    # before the call to the supervisor, which is slow on a busy machine
    present = {name: (monitor.age_s(), monitor.rate_hz()) for name, monitor in monitors.items()}
    newest = {name: one.newest if one.is_fresh() else None for name, one in monitors.items()}
    infos = fleet.info()
    roster = newest.get(ROSTER)
    recorder = roster.trouble if isinstance(roster, ToolRoster) else ()
    return FleetStatus(
        run_dir=str(fleet.run.path),
        config=fleet.manifest.config,
        services={row.name: _service_status(row, *present.get(row.name, ())) for row in infos},
        modules={
            module: module_status(
                newest[module], monitors[module].refusals(), stop_source(fleet.run.path, module)
            )
            for module in MODULES
            if module in monitors
        },
        lead=_lead_status(newest.get(PLANNER)),
        network=impairments(fleet),
        pace=pace(),
        security=bus.mode,
        tools=_tools_of(roster),
        trouble=(*_trouble_of(fleet, infos), *recorder),
        bus_faults=bus.describe({row.name: row.pid for row in infos if row.pid is not None}),
    )


def _service_status(
    info: ServiceInfo, age_s: float | None = None, rate_hz: float | None = None
) -> ServiceStatus:
    known = msgspec.structs.asdict(info)
    return ServiceStatus(**known, age_s=age_s, rate_hz=rate_hz, real_time=_real_time(info))


def _is_read_only(folder: Path) -> bool:
    """Return True if a disk rejects a new, unnamed file; mount options may not show this."""
    try:
        os.close(os.open(folder, os.O_TMPFILE | os.O_WRONLY, 0o600))
    except OSError as error:
        return error.errno in (errno.EROFS, errno.EIO)
    return False


def _trouble_of(fleet: SupervisedFleet, services: Iterable[ServiceInfo]) -> tuple[str, ...]:
    fault = fleet.supervision_fault()
    lines = [fault] if fault else []
    lost, why = (0, "") if fault else fleet.lost_lines()  # with a fault this would time out too
    if lost:
        lines.append(f"log lines are lost: {lost} in {fleet.run.logs}: {why}")
    if not os.access(fleet.run.live, os.W_OK):
        lines.append(
            f"{fleet.run.live}: read-only or missing: a service that ends cannot restart; hang the "
            "robot, then run `xrl down`"
        )
    if _is_read_only(fleet.run.path):
        lines.append(
            f"{fleet.run.path}: its disk is read-only: logs and records on it are lost. "
            "Services still restart, but a new fleet cannot start: hang the robot, "
            "run `xrl down`, then repair the disk"
        )
    try:
        free_mib = free_mib_at(fleet.run.path)
    except OSError as error:
        lines.append(f"{fleet.run.path}: {error.strerror}")
    else:
        if free_mib < SPACE_LOW_MIB:
            lines.append(f"{fleet.run.path}: {free_mib:.1f} MiB free; free some space")
    return (
        *lines,
        *(
            f"{row.name}: {row.last_exit}, starts so far: {row.restarts + 1}; {row.last_line}"
            for row in services
            if row.state in ("backoff", "starting") and row.last_exit
        ),
    )


def _real_time(service: ServiceInfo) -> bool | None:
    """Return whether a running service that needs real-time priority has it, else None."""
    wanted = service.name in MODULES or service.name in scheduling.TABLE
    running = service.pid is not None and service.state == "running"
    return scheduling.has_real_time(service.pid) if wanted and running and service.pid else None


def impairments(fleet: SupervisedFleet) -> tuple[str, ...]:
    """Return the active impairments as text; empty without a network proxy."""
    if "network_proxy" not in fleet.manifest.services:
        return ()
    try:
        return tuple(row.describe() for row in ProxyClient(fleet.run.path).list())
    except FleetError:
        return (SILENT_PROXY,)


def module_status(
    state: Message | None, refusals: tuple[RefusedCommands, ...] = (), stopped_by: str = ""
) -> ModuleStatus:
    """Return a module's status from the newest state of its joint service."""
    if not isinstance(state, JointState):
        return ModuleStatus()
    mode = state.mode
    knows = state.drive not in (*LOST_DRIVE, DriveStatus.UNZEROED)
    return ModuleStatus(
        mode=name_of(Mode, mode),
        tier=TIERS.get(Mode(mode)) if mode in tuple(Mode) else None,
        cause=name_of(Cause, state.cause),
        drive=name_of(DriveStatus, state.drive),
        q=state.q if knows else None,
        way_out=remedy_of(state),
        stiffened=state.stiffened and mode in (Mode.HOLD, Mode.DAMP),
        outside=name_of(Outside, state.outside) if state.outside else "",
        session=state.session,
        refusals=refusals,
        stopped_by=stopped_by if state.cause == Cause.ESTOP else "",
        celsius=state.celsius if state.heat_left_s >= 0.0 else None,
        heat_left_s=state.heat_left_s if state.heat_left_s >= 0.0 else None,
    )


def _lead_status(message: Message | None) -> LeadStatus | None:
    """Return the planner's state from its newest status."""
    if not isinstance(message, PlannerStatus):
        return None
    mode = name_of(PlannerMode, message.mode)
    return LeadStatus(
        mode,
        message.wait_s,
        message.margin,
        reason_of(message),
        message.session,
        message.carried_n,
        WEARING.get(message.wearer, ""),
    )


def _tools_of(message: Message | None) -> tuple[str, ...]:
    """Return the linked tools from the recorder's newest roster, except this process."""
    own = f".{place_of_tool()}"
    if not isinstance(message, ToolRoster):
        return ()
    return tuple(name for name in message.tools if not name.endswith(own))


def _listen(
    monitors: Mapping[str, RateMonitor],
    duration_s: float,
    until: Callable[[], bool] = lambda: False,
) -> None:
    deadline = time.monotonic() + duration_s
    while time.monotonic() < deadline and not until():
        for monitor in monitors.values():
            monitor.listen()
        time.sleep(_POLL_S)
