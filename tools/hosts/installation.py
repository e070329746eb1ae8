"""Brings each host's files there, starts and stops its unit, and looks whether all hosts agree."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from shared.robot.joints import MODULES
from tools.fleet.fleet_status import FleetStatus, ModuleStatus
from tools.hosts.hosts_file import Host, Hosts, principals_on
from tools.hosts.layout import (
    KEYS,
    ROBOT_FILE,
    RUN_DIR,
    SCHEDULE,
    UNIT,
    robot_on_hosts,
    unit,
)
from tools.hosts.probe import Probe, digest
from tools.hosts.remote import ClockOffset, Remote
from tools.keys.authority import Authority
from tools.keys.bundle import bundle

CLOCK_MAX_S: Final = 1.0
"""Certificates and the names of records go by the clock; ages do not."""
_UNIT_FOLDER: Final = "/etc/systemd/system"


class HostFile(NamedTuple):
    """One file of a host."""

    path: str
    content: bytes
    mode: int
    of_service: bool
    """True: it belongs to who runs the services; else to root."""


class HostRow(NamedTuple):
    """One host in the table of `xrl hosts check`."""

    name: str
    revision: str
    clock: ClockOffset | None
    unit: str
    """State of its unit by systemd."""
    wrong: tuple[str, ...]
    warnings: tuple[str, ...]


def files_of(
    hosts: Hosts, host: Host, robot: RobotConfig, schedule: bytes, authority: Authority | None
) -> list[HostFile]:
    """Return what a host has to have; without an authority all but its keys.

    Raises:
        BusError: the authority has no certificate of a name.
    """
    spread = robot_on_hosts(robot, hosts)
    folder = hosts.folder
    files = [
        HostFile(f"{folder}/{ROBOT_FILE}", config_file.to_toml(spread).encode(), 0o644, False),
        HostFile(f"{folder}/{SCHEDULE}", schedule, 0o644, False),
        HostFile(f"{_UNIT_FOLDER}/{UNIT}", unit(hosts, host).encode(), 0o644, False),
    ]
    if authority is not None:
        keys = bundle(authority, principals_on(host))
        files += [HostFile(f"{folder}/{KEYS}/{n}", text, 0o600, True) for n, text in keys.items()]
    return files


def update(hosts: Hosts, remote: Remote, files: list[HostFile]) -> str:
    """Bring files to a host; its services take them at their next start.

    Raises:
        FleetError: the host is not reached, or a file cannot be written.
    """
    folder = hosts.folder
    remote.must("install", "-d", "-m", "755", folder)
    remote.must("install", "-d", "-m", "700", "-o", hosts.user, f"{folder}/{KEYS}")
    for file in files:
        owner = hosts.user if file.of_service else "root"
        remote.write(file.path, file.content, file.mode, owner)
    remote.must("systemctl", "daemon-reload")
    remote.must("systemctl", "enable", "--quiet", UNIT)
    return f"{len(files)} files"


def up(hosts: Hosts, remote: Remote, *, armed: bool) -> str:
    """Start a host's services; a person asks for them, so their drives are armed.

    Raises:
        FleetError: the unit does not start, or a service cannot be asked for.
    """
    remote.must("systemctl", "start", UNIT)
    modules = [name for name in remote.host.services if name in MODULES] if armed else []
    for module in modules:
        remote.must(_xrl(hosts), "kill", module, "--run-dir", RUN_DIR, as_user=True)
    return f"up: {', '.join(remote.host.services)}{'' if armed else '; no drive armed'}"


def down(remote: Remote) -> str:
    """Stop a host's services.

    Raises:
        FleetError: they do not stop.
    """
    remote.must("systemctl", "stop", UNIT)
    return "down"


def status(hosts: Hosts, remote: Remote) -> FleetStatus:
    """Return a host's status.

    Raises:
        FleetError: no fleet is up there.
    """
    said = remote.must(_xrl(hosts), "status", "--json", "--run-dir", RUN_DIR, as_user=True)
    try:
        return msgspec.json.decode(said.encode(), type=FleetStatus)
    except msgspec.DecodeError as error:
        raise FleetError(f"{remote.host.name}: no status: {error}") from None


def joined(found: dict[str, FleetStatus]) -> FleetStatus:
    """Return one status of all hosts: a module as the first host that hears it has it."""
    services = {
        f"{host}: {name}": row for host, one in found.items() for name, row in one.services.items()
    }
    modules: dict[str, ModuleStatus] = {}
    for one in found.values():
        for name, row in one.modules.items():
            if name not in modules or (modules[name].mode is None and row.mode is not None):
                modules[name] = row
    first = next(iter(found.values()))
    lead = next((one.lead for one in found.values() if one.lead is not None), None)
    return msgspec.structs.replace(
        first, run_dir=", ".join(found), services=services, modules=modules, lead=lead
    )


def check(hosts: Hosts, remote: Remote, files: list[HostFile]) -> HostRow:
    """Look at a host, and compare it with what it has to have.

    Raises:
        FleetError: it is not reached, or has no checkout.
    """
    python, config = f"{hosts.checkout}/.venv/bin/python", f"{hosts.folder}/{ROBOT_FILE}"
    # the module is found in the installed package, wherever the command starts
    line, clock = remote.echoed(python, "-m", "tools.hosts.probe", "--config", config)
    try:
        probe = msgspec.json.decode(line.encode(), type=Probe)
    except msgspec.DecodeError:
        raise FleetError(f"{remote.host.name}: {hosts.checkout} is of another version") from None
    wanted = {Path(file.path).name: digest(file.content) for file in files}
    wrong = list(probe.wrong)
    if probe.robot != wanted[ROBOT_FILE]:
        wrong.append("another robot file; `xrl hosts update`")
    if probe.schedule != wanted[SCHEDULE]:
        wrong.append("another gain schedule; `xrl hosts update`")
    own_unit = remote.run("cat", f"{_UNIT_FOLDER}/{UNIT}").out
    if digest(own_unit.encode()) != wanted[UNIT]:
        wrong.append("another unit; `xrl hosts update`")
    warnings = list(probe.warnings)
    if abs(clock.offset_s) > CLOCK_MAX_S + clock.round_trip_s:
        warnings.append(f"its clock is {clock.offset_s:+.1f} s off: certificates go by it")
    state = remote.run("systemctl", "is-active", UNIT).out.strip() or "no systemd"
    return HostRow(remote.host.name, probe.revision, clock, state, tuple(wrong), tuple(warnings))


def disagreements(rows: list[HostRow]) -> list[str]:
    """Return what is not the same on all hosts."""
    revisions = {row.revision for row in rows}
    if len(revisions) < 2:
        return []
    return [f"several versions: {', '.join(f'{row.name} {row.revision}' for row in rows)}"]


def _xrl(hosts: Hosts) -> str:
    return f"{hosts.checkout}/.venv/bin/xrl"
