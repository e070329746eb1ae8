"""Each host's files: robot file and systemd unit. Pure: text from text."""

from __future__ import annotations

from typing import Final

import msgspec

from shared.config.robot_config import RobotConfig
from shared.config.sections import BusSecurityConfig
from tools.hosts import private_network
from tools.hosts.hosts_file import Host, Hosts, ports

ROBOT_FILE: Final = "robot.toml"
SCHEDULE: Final = "robot.gains.json"
KEYS: Final = "keys"
UNIT: Final = private_network.SERVICES_UNIT
RUN_DIR: Final = "/var/lib/xrl/run"
"""On the disk and not in memory: an emergency stop outlasts a power cut, once the kernel has
written it, within half a minute."""
RECORDS: Final = "/var/lib/xrl/out"
"""Where the services, which start in /var/lib/xrl, keep their records: a folder for each start."""

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
    of_unit = of_service = ""
    if host.private:
        # Wants, not Requires: whoever stops that unit is not to idle the drives.
        of_unit = f"After={private_network.UNIT}\nWants={private_network.UNIT}\n"
        of_service = f"NetworkNamespacePath={private_network.PATH}\n"
    return f"""\
# Made by `xrl hosts`; what it is for stands in docs/hosts.md.
[Unit]
Description=Extra Robotic Legs: {", ".join(host.services)}
After=network-online.target
Wants=network-online.target
{of_unit}
[Service]
Type=forking
PIDFile={RUN_DIR}/supervisord.pid
ExecStart={xrl} up --no-sim --disarmed --config {hosts.folder}/{ROBOT_FILE} \\
  --run-dir {RUN_DIR} --only {",".join(host.processes)}
ExecStop={xrl} down --keep-stops --run-dir {RUN_DIR}
Restart=always
RestartSec=2
# A start that were cut short would idle the drives of what is up.
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
{processors}{of_service}NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=strict
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
