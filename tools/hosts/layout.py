"""Each host's files: robot file, firewall and systemd unit. Pure: text from text."""

from __future__ import annotations

from typing import Final

import msgspec

from shared.config.endpoints import host_and_port
from shared.config.robot_config import RobotConfig
from shared.config.sections import BusSecurityConfig
from shared.joints import MODULES
from shared.places import FILES
from tools.hosts.hosts_file import Host, Hosts, ports

ROBOT_FILE: Final = "robot.toml"
SCHEDULE: Final = "robot.gains.json"
KEYS: Final = "keys"
FIREWALL: Final = "xrl.nft"
UNIT: Final = "xrl.service"
RUN_DIR: Final = "/var/lib/xrl/run"
"""On the disk and not in memory: an emergency stop outlasts a power cut, once the kernel has
written it, within half a minute."""

NFT: Final = "/usr/sbin/nft"

_SIMULATOR_HOST: Final = "127.0.0.1"


def robot_on_hosts(robot: RobotConfig, hosts: Hosts) -> RobotConfig:
    """Return the robot with each service at its host's address, under `mtls`."""
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

    It comes back after a crash and after a power cut, and arms no drive then: a drive that still
    holds is taken over, and any other waits for a person.
    """
    xrl = f"{hosts.checkout}/.venv/bin/xrl"
    processors = f"CPUAffinity={host.processors}\n" if host.processors else ""
    # Joint services throw old frames away by a restart of the CAN interface (docs/drives.md).
    granted = "CAP_NET_ADMIN" if set(host.services) & set(MODULES) else ""
    capabilities = f"CapabilityBoundingSet={granted}"
    if granted:
        capabilities += f"\nAmbientCapabilities={granted}"
    return f"""\
# Made by `xrl hosts`; what it is for stands in docs/hosts.md.
[Unit]
Description=Extra Robotic Legs: {", ".join(host.services)}
After=network-online.target
Wants=network-online.target

[Service]
Type=forking
PIDFile={RUN_DIR}/supervisord.pid
# As root. The services start without it, too: strangers can only keep new links off.
ExecStartPre=+-{NFT} -f {hosts.folder}/{FIREWALL}
ExecStart={xrl} up --no-sim --disarmed --config {hosts.folder}/{ROBOT_FILE} \\
  --run-dir {RUN_DIR} --only {",".join(host.processes)}
ExecStop={xrl} down --limp --keep-stops --run-dir {RUN_DIR}
Restart=always
RestartSec=2
# A start that is cut short would idle the drives of what is up.
TimeoutStartSec=infinity
TimeoutStopSec=30
# Nor are they all to go because one process took too much memory.
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
# for the sockets of the services: `live_dir` in shared/run_directory.py
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
    """Return the rules by which only the robot's hosts and `allow` reach the services' ports."""
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
