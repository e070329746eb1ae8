"""A robot whose bus is `mtls`, its keys in a test's own folder, and strangers on that bus."""

from __future__ import annotations

import datetime as dt
import json
import socket
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from shared.bus.credentials import AUTHORITY
from shared.config.robot_config import SERVICES, RobotConfig
from shared.config.sections import BusSecurityConfig
from tools.keys import authority, certificates
from tools.keys.authority import Authority
from tools.keys.certificates import CERTIFICATE_DAYS, Issued


def tls_endpoints(host: str = "127.0.0.1") -> dict[str, str]:
    """Return an endpoint at a free port for each service."""
    with ExitStack() as stack:
        probes = {name: stack.enter_context(socket.socket()) for name in SERVICES}
        for probe in probes.values():
            probe.bind((host, 0))
        return {name: f"tls/{host}:{probe.getsockname()[1]}" for name, probe in probes.items()}


def certified(
    robot: RobotConfig,
    folder: Path,
    endpoints: Mapping[str, str] | None = None,
    allow: tuple[str, ...] = (),
) -> tuple[RobotConfig, Authority]:
    """Return the robot under `mtls`, all of its keys installed in `folder`/keys.

    Its services then take each other to be of this host, and listen at ports only with `allow`.
    """
    security = BusSecurityConfig(mode="mtls", keys=str(folder / "keys"), allow=allow)
    bus = msgspec.structs.replace(
        robot.bus, endpoints=dict(endpoints or tls_endpoints()), security=security
    )
    robot = msgspec.structs.replace(robot, bus=bus)
    made = authority.make(folder / "authority", robot, CERTIFICATE_DAYS)
    install_all(made, folder / "keys")
    return robot, made


def install_all(made: Authority, folder: Path, *names: str) -> None:
    """Install a bundle of these names, or of all."""
    authority.install(authority.bundle(made, names or made.names.generations), folder)


def opened(robot: RobotConfig, endpoints: Mapping[str, str]) -> RobotConfig:
    """Return the robot with these endpoints under `mode = "open"`."""
    security = BusSecurityConfig(mode="open")
    bus = msgspec.structs.replace(robot.bus, endpoints=dict(endpoints), security=security)
    return msgspec.structs.replace(robot, bus=bus)


def with_keys(robot: RobotConfig, folder: Path) -> RobotConfig:
    """Return the robot with another folder of keys."""
    security = msgspec.structs.replace(robot.bus.security, keys=str(folder))
    return msgspec.structs.replace(robot, bus=msgspec.structs.replace(robot.bus, security=security))


def signer_of(made: Authority) -> Issued:
    return Issued(made.certificate, (made.folder / "authority.key").read_bytes())


def give(
    signer: Issued,
    folder: Path,
    name: str,
    *,
    generation: int = 1,
    from_day: int = 0,
    days: int = 90,
    host: str = "127.0.0.1",
) -> None:
    """Write a certificate and its key, whose time begins a day before `from_day` from today."""
    then = dt.datetime.now(dt.UTC) + dt.timedelta(days=from_day)
    issued = certificates.issue(signer, f"{name}.{generation}", (host,), then, days)
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.pem").write_bytes(issued.certificate)
    (folder / f"{name}.key").write_bytes(issued.key)


def stranger(endpoints: Sequence[str], tls: dict[str, Any] | None = None) -> zenoh.Session:
    """Open a session without any rule of ours: as somebody with a Zenoh of his own does."""
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "connect/endpoints": list(endpoints),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "open/return_conditions/connect_scouted": False,
        **({"transport/link/tls": tls} if tls else {}),
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def identity(folder: Path, name: str, authority: Path | None = None) -> dict[str, Any]:
    """Return Zenoh's settings with a name's certificate of a folder."""
    certificate, key = str(folder / f"{name}.pem"), str(folder / f"{name}.key")
    return {
        "root_ca_certificate": str(authority or folder / AUTHORITY),
        "connect_certificate": certificate,
        "connect_private_key": key,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "enable_mtls": True,
        "verify_name_on_connect": False,
    }
