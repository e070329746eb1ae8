"""Start, stop and query the services of hosts through their systemd units."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Final

import msgspec

from shared.bus.messages import DriveStatus, Mode
from shared.bus.topics import OPERATOR
from shared.exceptions import FleetError
from shared.joints import MODULES
from tools.fleet.fleet_status import FleetStatus, ModuleStatus
from tools.hosts.hosts_file import Hosts
from tools.hosts.layout import RUN_DIR, UNIT, is_up
from tools.hosts.remote import Remote

HEARD_S: Final = 10.0
"""Timeout for the first state of a joint service, s."""
ESTOP_S: Final = 10.0
"""Timeout for a host's answer to an emergency stop, s; without an answer, its modules may not have
stopped."""
_ARMABLE: Final = (DriveStatus.IDLE.name, DriveStatus.ERROR.name)


def start(remote: Remote) -> str:
    """Start a host's services, which take over drives that hold, and arm none."""
    remote.must("systemctl", "start", UNIT)
    return f"up: {', '.join(remote.host.services)}"


def heard(hosts: Hosts, remote: Remote) -> FleetStatus:
    """Return a host's status once all its own modules send states."""
    deadline = time.monotonic() + HEARD_S
    while True:
        found = status(hosts, remote)
        silent = [name for name in _modules_of(remote) if found.modules[name].mode is None]
        if not silent:
            return found
        if time.monotonic() > deadline:
            raise FleetError(
                f"{remote.host.name}: {', '.join(silent)}: no state for {HEARD_S:g} s, so nothing "
                "is armed; see `journalctl -u xrl` there"
            )


def stopped_in(found: Iterable[FleetStatus]) -> dict[str, str]:
    """Return the modules in an emergency stop, each with the person who requested it, or ""."""
    stopped: dict[str, str] = {}
    for one in found:
        for name, row in one.modules.items():
            if row.mode == Mode.DAMP.name or row.stopped_by:
                stopped[name] = stopped.get(name) or row.stopped_by
    return stopped


def arm(hosts: Hosts, remote: Remote, found: FleetStatus) -> str:
    """Let the host's joint services arm drives that are IDLE or in ERROR, and no others."""
    idle = [name for name in _modules_of(remote) if found.modules[name].drive in _ARMABLE]
    for module in idle:
        remote.must(_xrl(hosts), "kill", module, "--run-dir", RUN_DIR, as_user=True)
    return f"armed the drives of {', '.join(idle)}" if idle else "no drive to arm"


def _modules_of(remote: Remote) -> list[str]:
    return [name for name in remote.host.services if name in MODULES]


def estop(hosts: Hosts, remote: Remote) -> str:
    """Stop a host's modules through its shared memory."""
    mine = _modules_of(remote)
    if not mine:
        return "no module here"
    words = ("estop", "--local", "--partly", ",".join(mine), "--run-dir", RUN_DIR)
    return remote.must(_xrl(hosts), *words, as_user=True, timeout_s=ESTOP_S).strip()


def lower(
    hosts: Hosts, remotes: Iterable[Remote], tell: Callable[[str], None], *, wait_s: float
) -> None:
    """Lower the robot from one host until its legs bear no weight; do nothing if no host is up.

    Raises:
        FleetError: the legs still carry the robot, or it is unknown whether they do.
    """
    try:
        up = [remote for remote in remotes if is_up(remote)]
        if not up:
            return
        first = min(up, key=lambda remote: OPERATOR not in remote.host.tools)
        words = ("down", "--lower-only", "--wait", f"{wait_s:g}", "--run-dir", RUN_DIR)
        first.follow(_xrl(hosts), *words, tell=tell, as_user=True)
    except FleetError as error:
        again = "run `xrl hosts down` again, or `xrl hosts down --limp` to let the robot drop"
        text = f"nothing was stopped: {error}. From this computer, {again}"
        raise FleetError(text) from None


def down(hosts: Hosts, remote: Remote) -> str:
    """Stop a host's services, and clear an emergency stop, because a person requests it."""
    remote.must("systemctl", "stop", UNIT)
    remote.must(_xrl(hosts), "down", "--limp", "--run-dir", RUN_DIR, as_user=True)
    return "down"


def status(hosts: Hosts, remote: Remote) -> FleetStatus:
    """Return a host's status."""
    words = (_xrl(hosts), "status", "--json", "--run-dir", RUN_DIR)
    said = remote.must(*words, as_user=True)
    try:
        return msgspec.json.decode(said.encode(), type=FleetStatus)
    except msgspec.DecodeError as error:
        raise FleetError(
            f"{remote.host.name}: invalid status: {error}; use the same checkout on every host"
        ) from None


def joined(found: dict[str, FleetStatus]) -> FleetStatus:
    """Return one status for all hosts; each module's is from the first host that receives it."""
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
