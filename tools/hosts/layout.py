"""Files of the hosts: contents, transfer and check."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import msgspec

from shared.bus.credentials import NAMES
from shared.config import files as config_file
from shared.config.endpoints import host_and_port
from shared.config.robot_config import RobotConfig
from shared.config.sections import BusSecurityConfig
from shared.exceptions import FleetError
from shared.joints import MODULES
from shared.places import FILES
from tools.hosts.hosts_file import Host, Hosts, ports, principals_on
from tools.hosts.probe import Probe, digest
from tools.hosts.remote import Remote
from tools.keys.authority import Authority, bundle

ROBOT_FILE: Final = "robot.toml"
SCHEDULE: Final = "robot.gains.json"
KEYS: Final = "keys"
FIREWALL: Final = "xrl.nft"
UNIT: Final = "xrl.service"
RUN_DIR: Final = "/var/lib/xrl/run"
"""On disk, so that an emergency stop survives a power cut once the kernel has written it (within
half a minute)."""

NFT: Final = "/usr/sbin/nft"

_SIMULATOR_HOST: Final = "127.0.0.1"


def robot_on_hosts(robot: RobotConfig, hosts: Hosts) -> RobotConfig:
    """Return the robot with `mtls` and each service at its host's address."""
    endpoints = {}
    for service, port in ports(hosts, robot).items():
        address = _SIMULATOR_HOST if service == "simulator" else hosts.host_of(service).address
        shown = f"[{address}]" if ":" in address else address
        endpoints[service] = f"tls/{shown}:{port}"
    security = BusSecurityConfig("mtls", f"{hosts.folder}/{KEYS}", hosts.allow)
    bus = msgspec.structs.replace(robot.bus, endpoints=endpoints, security=security)
    return msgspec.structs.replace(robot, bus=bus)


def unit(hosts: Hosts, host: Host) -> str:
    """Return the systemd unit that runs a host's services.

    It restarts after a crash or a power cut. The services then take over drives that still hold,
    and arm no other drive.
    """
    xrl = f"{hosts.checkout}/.venv/bin/xrl"
    processors = f"CPUAffinity={host.processors}\n" if host.processors else ""
    # Joint services restart the CAN interface to discard old frames (docs/drives.md).
    granted = "CAP_NET_ADMIN" if set(host.services) & set(MODULES) else ""
    capabilities = f"CapabilityBoundingSet={granted}"
    if granted:
        capabilities += f"\nAmbientCapabilities={granted}"
    return f"""\
# Made by `xrl hosts` (docs/hosts.md).
[Unit]
Description=Extra Robotic Legs: {", ".join(host.services)}
After=network-online.target
Wants=network-online.target

[Service]
Type=forking
PIDFile={RUN_DIR}/supervisord.pid
# Runs as root. If it fails, the services still start; strangers can only block new links.
ExecStartPre=+-{NFT} -f {hosts.folder}/{FIREWALL}
ExecStart={xrl} up --no-sim --disarmed --config {hosts.folder}/{ROBOT_FILE} \\
  --run-dir {RUN_DIR} --only {",".join(host.processes)}
ExecStop={xrl} down --limp --keep-stops --run-dir {RUN_DIR}
Restart=always
RestartSec=2
# An interrupted start would idle the drives of services that are up.
TimeoutStartSec=infinity
TimeoutStopSec=30
# A process that takes too much memory must not end the others.
OOMPolicy=continue
OOMScoreAdjust=-500
User={hosts.user}
StateDirectory=xrl
StateDirectoryMode=0750
WorkingDirectory=/var/lib/xrl
UMask=0027
LimitRTPRIO=40
LimitMEMLOCK=infinity
LimitCORE=0
{processors}NoNewPrivileges=yes
{capabilities}
ProtectSystem=strict
# For the sockets of the services: `live_dir` in shared/run_directory.py.
ReadWritePaths=-/run/lock
ProtectHome=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectControlGroups=yes
PrivateTmp=yes
RestrictSUIDSGID=yes
LockPersonality=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_CAN AF_NETLINK

[Install]
WantedBy=multi-user.target
"""


def firewall(robot: RobotConfig) -> str:
    """Return rules that let only the robot's hosts and `allow` reach the services' ports."""
    ends = [host_and_port(endpoint) for endpoint in robot.bus.endpoints.values()]
    addresses = sorted({*(host for host, _ in ends), *robot.bus.security.allow})
    elements = {
        "ports": sorted({str(port) for _, port in ends}),
        "hosts4": [address for address in addresses if ":" not in address],
        "hosts6": [address for address in addresses if ":" in address],
    }
    lines = [
        f"add element inet xrl {name} {{ {', '.join(found)} }}"
        for name, found in elements.items()
        if found
    ]
    rules = (FILES / "nftables" / FIREWALL).read_text(encoding="utf-8")
    return "\n".join([rules.rstrip(), *lines, ""])


_AT_REST: Final = ("inactive", "failed", "unknown")
"""States of a unit whose services are down."""
_UNIT_FOLDER: Final = "/etc/systemd/system"


class HostFile(NamedTuple):
    """A file for a host."""

    path: str
    content: bytes
    of_service: bool = False
    """True if the file belongs to the services' user, who alone may read it; otherwise to root."""


class HostRow(NamedTuple):
    """One host in the table of `xrl hosts check`."""

    name: str
    reached: bool = False
    revision: str = ""
    unit: str = "-"
    """State of its unit as systemd reports it."""
    made_from: tuple[str, str] = ("", "")
    """Hash of the lock file, and Python version."""
    wrong: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def files_of(
    hosts: Hosts, host: Host, robot: RobotConfig, schedule: bytes, authority: Authority | None
) -> list[HostFile]:
    """Return the files that a host must have; its keys are left out if there is no authority."""
    spread = robot_on_hosts(robot, hosts)
    folder = hosts.folder
    files = [
        HostFile(f"{folder}/{ROBOT_FILE}", config_file.to_toml(spread).encode()),
        HostFile(f"{folder}/{SCHEDULE}", schedule),
        HostFile(f"{folder}/{FIREWALL}", firewall(spread).encode()),
        HostFile(f"{_UNIT_FOLDER}/{UNIT}", unit(hosts, host).encode()),
    ]
    if authority is not None:
        keys = bundle(authority, principals_on(host))
        files += [
            HostFile(f"{folder}/{KEYS}/{n}", text, of_service=True) for n, text in keys.items()
        ]
    return files


def update(hosts: Hosts, remote: Remote, files: list[HostFile], *, while_up: bool) -> str:
    """Copy files to a host, and delete keys that it must not have; the next start applies them."""
    if not while_up:
        _refuse_up(remote)
    folder = hosts.folder
    keys = f"{folder}/{KEYS}"
    remote.must("install", "-d", "-m", "755", folder)
    remote.must("install", "-d", "-m", "700", "-o", hosts.user, keys)
    for file in files:
        remote.write(file.path, file.content, private=file.of_service)
    names = [Path(file.path).name for file in files if file.of_service]
    others = [word for name in names for word in ("!", "-name", name)]
    remote.must(
        "find", keys, "-maxdepth", "1", "(", "-name", "*.pem", "-o", "-name", "*.key", ")",
        *others, "-delete", as_user=True,
    )  # fmt: skip
    remote.must("systemctl", "daemon-reload")
    remote.must("systemctl", "enable", "--quiet", UNIT)
    return f"{len(files)} files"


def is_up(remote: Remote) -> bool:
    """Return True unless a host's services are known to be down."""
    return _state(remote) not in _AT_REST


def _refuse_up(remote: Remote) -> None:
    """Refuse new files while a host's services are up."""
    state = _state(remote)
    if state not in _AT_REST:
        raise FleetError(
            f"{remote.host.name}: its services may be up (unit: {state}); a service that crashes "
            "would restart with the new files while the others use the old; run `xrl hosts down` "
            "first, or use --while-up"
        )


def check(hosts: Hosts, remote: Remote, files: list[HostFile]) -> HostRow:
    """Compare a host with the files that it must have."""
    python, config = f"{hosts.checkout}/.venv/bin/python", f"{hosts.folder}/{ROBOT_FILE}"
    # -P: import the module from the installed package, whatever the working directory
    words = ("-P", "-m", "tools.hosts.probe", "--config", config, "--run-dir", RUN_DIR)
    line = remote.must(python, *words, as_user=True)
    try:
        probe = msgspec.json.decode(line.encode(), type=Probe)
    except msgspec.DecodeError:
        text = f"{hosts.checkout} has another version; use the same checkout on every host"
        raise FleetError(f"{remote.host.name}: {text}") from None
    wanted = {Path(file.path).name: digest(file.content) for file in files if not file.of_service}
    wrong = list(probe.wrong)
    if probe.robot != wanted[ROBOT_FILE]:
        wrong.append("its robot file differs; run `xrl hosts update`")
    if probe.schedule != wanted[SCHEDULE]:
        wrong.append("its gain schedule differs; run `xrl hosts update`")
    wrong += _about_keys(probe, {Path(f.path).name: f.content for f in files if f.of_service})
    if digest(remote.run("cat", f"{_UNIT_FOLDER}/{UNIT}").out.encode()) != wanted[UNIT]:
        wrong.append(f"its {UNIT} differs; run `xrl hosts update`")
    state, warnings = _state(remote), list(probe.warnings)
    if state not in _AT_REST and remote.run(NFT, "list", "table", "inet", "xrl").code:
        warnings.append(f"no firewall on its ports; run `nft -f {hosts.folder}/{FIREWALL}`")
    if not probe.revision:
        wrong.append(f"version unknown: {hosts.checkout} is not a readable git checkout")
    if probe.revision.endswith("+"):
        warnings.append(f"{hosts.checkout} has local changes")
    return HostRow(
        name=remote.host.name,
        reached=True,
        revision=probe.revision,
        unit=state,
        made_from=(probe.lock, probe.python),
        wrong=tuple(wrong),
        warnings=tuple(warnings),
    )


def _about_keys(probe: Probe, wanted: dict[str, bytes]) -> list[str]:
    """Return how a host's keys differ from those that it must have."""
    wrong = []
    wanted_now = {name: digest(content) for name, content in wanted.items()}
    other = sorted(n for n, found in wanted_now.items() if probe.keys.get(n) != found)
    extra = sorted(set(probe.keys) - set(wanted))
    if NAMES in other:
        wrong.append("accepts key generations that are not the authority's; run `xrl hosts update`")
        other.remove(NAMES)
    if other:
        wrong.append(
            f"keys differ from the authority's: {', '.join(other)}; run `xrl hosts update`"
        )
    if wanted and extra:
        wrong.append(f"keys that it must not have: {', '.join(extra)}; run `xrl hosts update`")
    return wrong


def _state(remote: Remote) -> str:
    return remote.run("systemctl", "is-active", UNIT).out.strip() or "no systemd"


def disagreements(rows: list[HostRow]) -> list[str]:
    """Return a line for each value that differs between the reachable hosts."""
    wrong = []
    for word, value_of in _SAME_ON_ALL.items():
        found = {row.name: value_of(row) for row in rows if row.reached}
        if len(set(found.values())) > 1:
            rest = ", ".join(f"{name} {value or 'none'}" for name, value in found.items())
            wrong.append(f"different {word}: {rest}")
    return wrong


_SAME_ON_ALL: Final[dict[str, Callable[[HostRow], str]]] = {
    "versions": lambda row: row.revision,
    "lock files": lambda row: row.made_from[0],
    "Python versions": lambda row: row.made_from[1],
}
