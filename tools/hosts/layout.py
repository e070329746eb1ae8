"""Each host's files: robot file, firewall and systemd units. Pure: text from text.

A host's services may have a network namespace of their own. A raw CAN socket needs no privilege, so
whoever may log in to a host could idle a drive; CAN interfaces that are moved into the namespace
are seen by the services alone. They talk to the other hosts by a macvlan on the robot's network,
which has the host's `address` there.
"""

from __future__ import annotations

import shlex
from typing import Final

import msgspec

from shared.config.endpoints import host_and_port
from shared.config.robot_config import RobotConfig
from shared.config.sections import BusSecurityConfig
from shared.joints import MODULES
from shared.places import FILES
from tools.bringup.check_host import setup_commands
from tools.hosts.hosts_file import Host, Hosts, ports

ROBOT_FILE: Final = "robot.toml"
SCHEDULE: Final = "robot.gains.json"
KEYS: Final = "keys"
FIREWALL: Final = "xrl.nft"
UNIT: Final = "xrl.service"
NETWORK_UNIT: Final = "xrl-net.service"
RUN_DIR: Final = "/var/lib/xrl/run"
"""On the disk and not in memory: an emergency stop outlasts a power cut, once the kernel has
written it, within half a minute."""
RECORDS: Final = "/var/lib/xrl/out"
"""Where the services, which start in /var/lib/xrl, keep their records: a folder for each start."""

NAMESPACE: Final = "xrl"
NETWORK_PATH: Final = f"/run/netns/{NAMESPACE}"
LINK: Final = "xrl0"
"""The services' interface on the robot's network."""
IP: Final = "/sbin/ip"
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
    inside = f"{IP} netns exec {NAMESPACE} " if host.private else ""
    of_unit = of_service = ""
    if host.private:
        # Wants, not Requires: whoever stops that unit is not to idle the drives.
        of_unit = f"After={NETWORK_UNIT}\nWants={NETWORK_UNIT}\n"
        of_service = f"NetworkNamespacePath={NETWORK_PATH}\n"
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
# As root. The services start without it, too: strangers can only keep new links off.
ExecStartPre=+-{inside}{NFT} -f {hosts.folder}/{FIREWALL}
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
{processors}{of_service}NoNewPrivileges=yes
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


def set_up_commands(host: Host) -> list[list[str]]:
    """Return the commands, for root, that make the namespace and move the interfaces into it.

    Each does its part or fails alone, and done twice they do nothing: the CAN interfaces, which a
    leg stands by, come before the network.
    """
    inside = [IP, "-n", NAMESPACE]
    commands = [[IP, "netns", "add", NAMESPACE], [*inside, "link", "set", "lo", "up"]]
    for name in host.private:
        commands += move_commands(name)
    duplicates = ["nodad"] if ":" in host.address else []
    return [
        *commands,
        [IP, "link", "add", LINK, "link", host.nic, "netns", NAMESPACE,
         "type", "macvlan", "mode", "bridge"],
        [*inside, "address", "add", f"{host.address}/{host.prefix}", "dev", LINK, *duplicates],
        [*inside, "link", "set", LINK, "up"],
    ]  # fmt: skip


def move_commands(name: str) -> list[list[str]]:
    """Return the commands that move one CAN interface into the namespace and bring it up there."""
    up = [[IP, "-n", NAMESPACE, *words[1:]] for words in setup_commands(name)]
    return [[IP, "link", "set", name, "netns", NAMESPACE], *up]


def tear_down_command() -> list[str]:
    """Return the command that takes the namespace's name away."""
    return [IP, "netns", "delete", NAMESPACE]


def network_unit(host: Host) -> str:
    """Return the systemd unit that has the namespace made before the services start.

    It does nothing while services run: a second namespace would have the address of theirs.
    """
    starts = "\n".join(f"ExecStart=-{shlex.join(words)}" for words in set_up_commands(host))
    end = shlex.join(tear_down_command())
    return f"""\
# Made by `xrl hosts`; what it is for stands in docs/hosts.md.
[Unit]
Description=Extra Robotic Legs: {", ".join(host.private)} for the services alone
After=network-online.target
Wants=network-online.target

[Service]
Type=oneshot
RemainAfterExit=yes
ExecCondition=/bin/sh -c '! systemctl --quiet is-active {UNIT}'
# Each may fail: one adapter that is missing is not to take the others with it.
{starts}
ExecStop=/bin/sh -c 'systemctl --quiet is-active {UNIT} || {end}'
"""
