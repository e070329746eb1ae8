"""`hosts.toml`: the services of each host (docs/hosts.md)."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final

from shared.bus.topics import HOST_RECORDER, OPERATOR, PRINCIPALS, RECORDER, VIEWER
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import ConfigError
from shared.joints import MODULES, SIDES, side_of
from shared.toml_file import Range, Section, read_toml

_TOOLS: Final = (OPERATOR, VIEWER)


class Host(Section, frozen=True):
    """One host."""

    name: str
    address: str
    """IP address at which the other hosts dial this host."""
    ssh: str
    """Destination for `ssh`, such as `root@10.0.0.2`, or a name in ~/.ssh/config. This user must be
    allowed to start systemd units."""
    services: tuple[str, ...]
    tools: tuple[str, ...] = (VIEWER,)
    """Principals whose keys the tools on this host use."""
    processors: str = ""
    """Processors for the services, in systemd's notation, such as `2-3`; empty for all."""
    record: bool = True
    """If the recorder is on another host, also record this host's services here. This recording
    needs a tool's key."""

    @property
    def processes(self) -> tuple[str, ...]:
        """Processes that `xrl up --only` starts here."""
        beside = self.record and bool(self.tools) and RECORDER not in self.services
        return (*self.services, HOST_RECORDER) if beside else self.services


class Hosts(Section, frozen=True):
    """Contents of a hosts file."""

    host: tuple[Host, ...]
    first_port: Annotated[int, Range(1024, 65_000, "1")] = 7447
    """Port of the first service; the others follow, in the order of `SERVICES`."""
    allow: tuple[str, ...] = ()
    """Addresses of other computers that may link to the services, such as laptops."""
    user: str = "xrl"
    """User that runs the services."""
    checkout: str = "/opt/xrl"
    folder: str = "/etc/xrl"
    """Folder on each host for robot file, gain schedule and keys."""
    ssh: tuple[str, ...] = (
        "ssh", "-o", "BatchMode=yes", "-o", "ConnectTimeout=5", "-o", "ServerAliveInterval=5",
    )  # fmt: skip

    def host_of(self, service: str) -> Host:
        """Return the host on which a service runs."""
        return next(host for host in self.host if service in host.services)

    def named(self, names: tuple[str, ...]) -> tuple[Host, ...]:
        """Return the named hosts; without names, all hosts."""
        known = {host.name: host for host in self.host}
        for name in names:
            if name not in known:
                raise ConfigError("HOST", name, "no such host", f"use one of {', '.join(known)}")
        return tuple(known[name] for name in names or known)


Problems = Iterator[tuple[str, str, str]]
"""Key, invalid value, and correct value."""


def load(path: Path, robot: RobotConfig) -> Hosts:
    """Read a hosts file, and check it against the robot file."""
    hosts = read_toml(path, Hosts)
    for key, found, right in _problems(hosts, robot):
        raise ConfigError(str(path), key, found, right)
    return hosts


def _problems(hosts: Hosts, robot: RobotConfig) -> Problems:
    for index, host in enumerate(hosts.host):
        for key, found, right in _of_host(host, hosts.host[:index], _real_services(robot)):
            yield f"host[{index}].{key}", found, right
    homes = {service: host.name for host in hosts.host for service in host.services}
    absent = [service for service in _real_services(robot) if service not in homes]
    if absent:
        yield "host", f"no host runs {', '.join(absent)}", "each must run on one host"
    for side in SIDES:
        if len({homes.get(name) for name in MODULES if side_of(name) == side}) > 1:
            right = "use one host: they see each other's failures in shared memory (docs/hosts.md)"
            yield "host", f"the {side} leg's services are on several hosts", right
    for index, address in enumerate(hosts.allow):
        yield from _of_address(f"allow[{index}]", address)
    for key, value in (("checkout", hosts.checkout), ("folder", hosts.folder)):
        if not re.fullmatch(r"/[A-Za-z0-9_./-]+", value):
            yield key, f"{value!r}", "must be an absolute path without spaces"
    if not re.fullmatch(r"[a-z_][a-z0-9_-]*", hosts.user):
        yield "user", f"{hosts.user!r}", "must be a user's name"


def _of_host(host: Host, before: tuple[Host, ...], known: tuple[str, ...]) -> Problems:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", host.name):
        yield "name", f"{host.name!r}", "must have only letters, digits, _ and -"
    yield from _of_address("address", host.address)
    if host.ssh.startswith("-") or not host.ssh.strip():
        yield "ssh", f"{host.ssh!r}", "must be an ssh destination: user@host"
    for key, value in (("name", host.name), ("address", host.address)):
        if value in (getattr(other, key) for other in before):
            yield key, f"{value!r} is used twice", "must be unique"
    if host.processors and not re.fullmatch(r"\d+(-\d+)?([ ,]\d+(-\d+)?)*", host.processors):
        yield "processors", f"{host.processors!r}", "must be in systemd's notation: 0-1,3"
    if not host.services:
        yield "services", "none", "must have at least one"
    for service in host.services:
        other = next((other.name for other in before if service in other.services), host.name)
        if service not in known:
            yield "services", f"no service {service!r}", f"must be one of {', '.join(known)}"
        if other != host.name or host.services.count(service) > 1:
            yield "services", f"{service!r} is also on {other}", "must be listed once"
    for tool in host.tools:
        if tool not in _TOOLS:
            yield "tools", f"{tool!r}", f"must be one of {', '.join(_TOOLS)}"


def _of_address(key: str, text: str) -> Problems:
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        yield key, f"{text!r}", "must be an IP address: names can be forged"
        return
    if address.is_unspecified or address.is_multicast:
        yield key, f"{text!r}", "must be the address of one host"


def _real_services(robot: RobotConfig) -> tuple[str, ...]:
    """Return the services of a real robot."""
    return tuple(service for service in robot.services if service != "simulator")


def principals_on(host: Host) -> tuple[str, ...]:
    """Return the principals whose certificates a host needs."""
    return tuple(name for name in PRINCIPALS if name in (*host.services, *host.tools))


def ports(hosts: Hosts, robot: RobotConfig) -> dict[str, int]:
    """Return the port of each service; the ports do not depend on which services are fitted."""
    return {
        service: hosts.first_port + index
        for index, service in enumerate(SERVICES)
        if service in robot.services
    }
