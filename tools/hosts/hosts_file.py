"""`hosts.toml`: which host runs what (docs/hosts.md)."""

from __future__ import annotations

import ipaddress
import re
from pathlib import Path
from typing import Annotated, Final

from shared.bus.topics import HOST_RECORDER, OPERATOR, PRINCIPALS, RECORDER, VIEWER
from shared.config.robot_config import SERVICES, RobotConfig
from shared.exceptions import ConfigError
from shared.joints import MODULES, SIDES, side_of
from shared.toml_file import Range, Section, read_toml

_TOOLS: Final = (OPERATOR, VIEWER)
_IPV4_BITS: Final = 32


class Host(Section, frozen=True):
    """One host."""

    name: str
    address: str
    """By which the other hosts dial it: an IP address."""
    ssh: str
    """As `ssh` takes it: `root@10.0.0.2`, or a name in ~/.ssh/config. It may start units."""
    services: tuple[str, ...]
    tools: tuple[str, ...] = (VIEWER,)
    """Whose key its tools have."""
    processors: str = ""
    """As systemd takes them: `2-3`; empty: all."""
    record: bool = True
    """Where the recorder is another host's: keep a record of this one's services here. It is a
    reader like any tool: without the key of one there is none."""

    private: tuple[str, ...] = ()
    """CAN interfaces that only the services reach, in a network namespace of their own."""
    nic: str = ""
    """With `private`: interface of the robot's network, on which the services have `address`."""
    prefix: Annotated[int, Range(1, 127, "1")] = 24
    """With `private`: length of the network's part of `address`; 64 as a rule for IPv6."""

    @property
    def processes(self) -> tuple[str, ...]:
        """What `xrl up --only` starts here."""
        beside = self.record and bool(self.tools) and RECORDER not in self.services
        return (*self.services, HOST_RECORDER) if beside else self.services


class Hosts(Section, frozen=True):
    """The whole file."""

    host: tuple[Host, ...]
    first_port: Annotated[int, Range(1024, 65_000, "1")] = 7447
    """The services' ports follow from here, in the order of the robot's services."""
    allow: tuple[str, ...] = ()
    """Further addresses that may link to the services: those of laptops with tools."""
    user: str = "xrl"
    """Who runs the services."""
    checkout: str = "/opt/xrl"
    folder: str = "/etc/xrl"
    """Where robot file, gain schedule and keys lie on each host."""
    ssh: tuple[str, ...] = (
        "ssh", "-o", "BatchMode=yes", "-o", "ConnectTimeout=5", "-o", "ServerAliveInterval=5",
    )  # fmt: skip

    def host_of(self, service: str) -> Host:
        """Return where a service runs."""
        return next(host for host in self.host if service in host.services)

    def named(self, names: tuple[str, ...]) -> tuple[Host, ...]:
        """Return hosts by their names; all of them without any."""
        known = {host.name: host for host in self.host}
        for name in names:
            if name not in known:
                raise ConfigError("HOST", name, "no such host", f"one of {', '.join(known)}")
        return tuple(known[name] for name in names or known)


def load(path: Path, robot: RobotConfig) -> Hosts:
    """Read and check a hosts file against the robot that runs on them."""
    hosts = read_toml(path, Hosts)
    _check(str(path), hosts, robot)
    return hosts


def _check(file: str, hosts: Hosts, robot: RobotConfig) -> None:
    services = real_services(robot)
    homes: dict[str, str] = {}
    for index, host in enumerate(hosts.host):
        where = f"host[{index}]"
        if not re.fullmatch(r"[A-Za-z0-9_-]+", host.name):
            right = "letters, digits, _ and - only"
            raise ConfigError(file, f"{where}.name", f"{host.name!r}", right)
        _check_address(file, f"{where}.address", host.address)
        if host.ssh.startswith("-") or not host.ssh.strip():
            raise ConfigError(file, f"{where}.ssh", f"{host.ssh!r}", "as ssh takes it: user@host")
        for key, value in (("name", host.name), ("address", host.address)):
            if value in (getattr(other, key) for other in hosts.host[:index]):
                raise ConfigError(file, f"{where}.{key}", f"{value!r} stands twice", "one each")
        if host.processors and not re.fullmatch(r"\d+(-\d+)?([ ,]\d+(-\d+)?)*", host.processors):
            found = f"{host.processors!r}"
            raise ConfigError(file, f"{where}.processors", found, "as systemd takes them: 0-1,3")
        _check_private(file, where, host)
        if not host.services:
            raise ConfigError(file, f"{where}.services", "none", "at least one")
        for service in host.services:
            if service not in services:
                right = f"one of {', '.join(services)}"
                raise ConfigError(file, f"{where}.services", f"no service {service!r}", right)
            other = homes.setdefault(service, host.name)
            if other != host.name or host.services.count(service) > 1:
                raise ConfigError(
                    file, f"{where}.services", f"{service!r} is {other}'s too", "once"
                )
        for tool in host.tools:
            if tool not in _TOOLS:
                right = f"one of {', '.join(_TOOLS)}"
                raise ConfigError(file, f"{where}.tools", f"{tool!r}", right)
    absent = [service for service in services if service not in homes]
    if absent:
        raise ConfigError(file, "host", f"{', '.join(absent)} runs nowhere", "each on one host")
    for side in SIDES:
        leg = [module for module in MODULES if side_of(module) == side]
        if len({homes[module] for module in leg}) > 1:
            found = f"the {side} leg's services are on several hosts"
            right = "one: they see each other's failures in shared memory (docs/hosts.md)"
            raise ConfigError(file, "host", found, right)
    for index, address in enumerate(hosts.allow):
        _check_address(file, f"allow[{index}]", address)
    for key, value in (("checkout", hosts.checkout), ("folder", hosts.folder)):
        if not re.fullmatch(r"/[A-Za-z0-9_./-]+", value):
            raise ConfigError(file, key, f"{value!r}", "an absolute path without spaces")
    if not re.fullmatch(r"[a-z_][a-z0-9_-]*", hosts.user):
        raise ConfigError(file, "user", f"{hosts.user!r}", "a user's name")


def _check_private(file: str, where: str, host: Host) -> None:
    for key, names in (("private", host.private), ("nic", (host.nic,) if host.nic else ())):
        for name in names:
            if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,14}", name):
                right = "a network interface's name"
                raise ConfigError(file, f"{where}.{key}", f"{name!r}", right)
    if host.private and not host.nic:
        right = "the interface of the robot's network, on which the services get `address`"
        raise ConfigError(file, f"{where}.nic", "missing beside `private`", right)
    if len({*host.private, host.nic}) <= len(host.private):
        right = "each interface once, and `nic` not among them"
        raise ConfigError(file, f"{where}.private", ", ".join(host.private), right)
    most = ipaddress.ip_address(host.address).max_prefixlen
    least = 1 if most == _IPV4_BITS else _IPV4_BITS
    if host.private and not least <= host.prefix < most:
        right = f"{least} to {most - 1}: the length of the network's part of `address`"
        raise ConfigError(file, f"{where}.prefix", str(host.prefix), right)
    if host.private and host.ssh.rpartition("@")[2] == host.address:
        right = "the host's own address: `address` is then the services'"
        raise ConfigError(file, f"{where}.ssh", f"{host.ssh!r}", right)
    if host.nic and not host.private:
        right = "the CAN interfaces that only the services are to reach"
        raise ConfigError(file, f"{where}.private", "missing beside `nic`", right)


def _check_address(file: str, where: str, text: str) -> None:
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        raise ConfigError(file, where, f"{text!r}", "an IP address: names can be forged") from None
    if address.is_unspecified or address.is_multicast:
        raise ConfigError(file, where, f"{text!r}", "the address of one host")


def real_services(robot: RobotConfig) -> tuple[str, ...]:
    """Return what runs on a real robot's hosts."""
    return tuple(service for service in robot.services if service != "simulator")


def principals_on(host: Host) -> tuple[str, ...]:
    """Return the names whose certificates a host needs."""
    return tuple(name for name in PRINCIPALS if name in (*host.services, *host.tools))


def ports(hosts: Hosts, robot: RobotConfig) -> dict[str, int]:
    """Return each service's port; an optional service keeps its own whether fitted or not."""
    return {
        service: hosts.first_port + index
        for index, service in enumerate(SERVICES)
        if service in robot.services
    }
