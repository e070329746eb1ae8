"""Starts, stops and looks at the services of hosts, by their units."""

from __future__ import annotations

import time
from typing import Final

import msgspec

from shared.bus.messages import Mode
from shared.exceptions import FleetError
from shared.robot.joints import MODULES
from tools.fleet.fleet_status import FleetStatus, ModuleStatus
from tools.hosts.hosts_file import Hosts
from tools.hosts.layout import RUN_DIR, UNIT
from tools.hosts.remote import Remote

HEARD_S: Final = 10.0
"""A joint service that is up is heard within this time."""
_LEADING: Final = (Mode.TRACK.name, Mode.HOLD.name)


def up(hosts: Hosts, remote: Remote, *, armed: bool) -> str:
    """Start a host's services; a person asks for them, so idle drives are armed.

    A module that tracks or holds is left alone, and so is one that an emergency stop holds.

    Raises:
        FleetError: the unit does not start, a joint service is not heard, or an emergency stop
            holds.
    """
    remote.must("systemctl", "start", UNIT)
    mine = [name for name in remote.host.services if name in MODULES] if armed else []
    found = _heard(hosts, remote, mine)
    stopped = {name: row for name, row in found.items() if row.mode == Mode.DAMP.name}
    idle = [name for name, row in found.items() if row.mode not in (*_LEADING, Mode.DAMP.name)]
    for module in idle:
        remote.must(_xrl(hosts), "kill", module, "--run-dir", RUN_DIR, as_user=True)
    if stopped:
        who = next((row.stopped_by for row in stopped.values() if row.stopped_by), "somebody")
        raise FleetError(
            f"{remote.host.name}: {', '.join(stopped)}: an emergency stop by {who} holds; "
            "`xrl hosts down`, then `up`, ends it"
        )
    rest = "" if armed else "; no drive armed"
    rest += f"; drives of {', '.join(idle)} are armed" if idle else ""
    return f"up: {', '.join(remote.host.services)}{rest}"


def _heard(hosts: Hosts, remote: Remote, mine: list[str]) -> dict[str, ModuleStatus]:
    """Return the status of a host's modules, once all are heard.

    Raises:
        FleetError: one is not.
    """
    if not mine:
        return {}
    deadline = time.monotonic() + HEARD_S
    while True:
        modules = status(hosts, remote).modules
        silent = [name for name in mine if modules[name].mode is None]
        if not silent:
            return {name: modules[name] for name in mine}
        if time.monotonic() > deadline:
            raise FleetError(
                f"{remote.host.name}: {', '.join(silent)}: not heard for {HEARD_S:g} s, so not "
                "armed; `journalctl -u xrl` there"
            )


def estop(hosts: Hosts, remote: Remote) -> str:
    """Stop a host's modules, by its shared memory.

    Raises:
        FleetError: the host is not reached, or a module has not stopped.
    """
    if not set(remote.host.services) & set(MODULES):
        return "no module here"
    words = ("estop", "--local", "--partly", "--run-dir", RUN_DIR)
    return remote.must(_xrl(hosts), *words, as_user=True).strip()


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


def _xrl(hosts: Hosts) -> str:
    return f"{hosts.checkout}/.venv/bin/xrl"
