"""Under `mtls`: which services run on this host, linked by UNIX sockets (docs/security.md).

A TLS listener of Zenoh reports ten failed handshakes a second and keeps the sockets of all others
until then, so whoever may connect to its port can keep new links off. A socket in the run directory
is this user's alone.
"""

from __future__ import annotations

import ipaddress
import socket
from typing import Final

from shared.bus import credentials
from shared.bus.allow_list import resolved
from shared.bus.security import TCP
from shared.config.endpoints import host_and_port
from shared.config.robot_config import RobotConfig
from shared.exceptions import BusError

_SOCKET: Final = "unixsock-stream/{{run}}/{service}.zenoh"
_ANY_PORT: Final = 9
"""Nothing is sent there."""


def services_here(robot: RobotConfig) -> frozenset[str]:
    """Return the services that run on this host: their keys are here, and their address is its own.

    A name lookup may block: at the start only.

    Returns:
        None of them unless the bus is `mtls`, or where this host has no keys.
    """
    if robot.bus.security.mode != "mtls":
        return frozenset()
    try:
        held = credentials.held_names(credentials.keys_folder(robot))
    except BusError:
        return frozenset()  # `open_session` refuses to go on without them
    return frozenset(s for s in robot.services if s in held and _is_own(robot.bus.endpoints[s]))


def endpoint_here(robot: RobotConfig, service: str, here: frozenset[str]) -> str:
    """Return where a process of this host reaches a service.

    Args:
        robot: its `bus`.
        service: which.
        here: of `services_here`.
    """
    if service in here:
        return _SOCKET.format(service=service)
    return robot.bus.endpoints[service]


def listening(robot: RobotConfig, service: str, here: frozenset[str]) -> tuple[str, ...]:
    """Return where a service of this host listens; at a port only if another host may link to it.

    Args:
        robot: its `bus`.
        service: which.
        here: of `services_here`.
    """
    own = endpoint_here(robot, service, here)
    public = robot.bus.endpoints[service]
    # The simulator runs where the fleet starts it; a real robot's hosts have no key of it.
    others = set(robot.services) - here - {"simulator"}
    return (own, public) if own != public and (others or robot.bus.security.allow) else (own,)


def ports_here(robot: RobotConfig) -> frozenset[int]:
    """Return the ports at which this host's services listen under `mtls`."""
    here = services_here(robot)
    endpoints = [endpoint for service in here for endpoint in listening(robot, service, here)]
    return frozenset(host_and_port(each)[1] for each in endpoints if each.startswith(TCP))


def _is_own(endpoint: str) -> bool:
    """Return True if an endpoint's host is this one. Nothing is sent."""
    addresses, _ = resolved([host_and_port(endpoint)[0]])
    return any(_is_own_address(address) for address in addresses)


def _is_own_address(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Ask for the route: to an own address it begins there. Binding would not tell.

    With `net.ipv4.ip_nonlocal_bind` any address can be bound.
    """
    if address.is_loopback:
        return True
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((str(address), _ANY_PORT))
        except OSError:  # no route
            return False
        return str(probe.getsockname()[0]) == str(address)
