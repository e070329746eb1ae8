"""Zenoh's settings for each `bus.security.mode` (docs/security.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from shared import log
from shared.bus import allow_list
from shared.bus.access import access_control
from shared.bus.credentials import held_names, read_credentials
from shared.config.endpoints import host_and_port
from shared.config.robot_config import ENDPOINTS_OF_MODE, RobotConfig
from shared.exceptions import BusError

UNIX: Final = "unixsock-stream/"
TCP: Final = ("tcp/", "tls/")

MESSAGE_MAX: Final = 1 << 20
"""Largest message that is put together from its fragments, bytes."""
PAYLOAD_MAX: Final = 1 << 16
"""Largest payload that is let in, bytes; the largest of the topics is a third of it."""
HANDSHAKE_MS: Final = 2_000
"""Longest TLS handshake that a listener waits for; Zenoh's own limit is 10 s."""
SESSIONS_MAX: Final = 128
"""Peers at a time, of all names together: viewers that hang are not to shut a planner out."""


def settings(robot: RobotConfig, process: str, endpoints: Sequence[str]) -> dict[str, object]:
    """Return the settings that keep strangers off.

    Args:
        robot: its `bus.security`.
        process: its name on the bus.
        endpoints: all that it listens on or dials, as Zenoh takes them.

    Raises:
        BusError: an endpoint is none of the mode's, or a key is missing.
    """
    mode = robot.bus.security.mode
    right_ones = ENDPOINTS_OF_MODE[mode] + ((UNIX,) if mode == "mtls" else ())
    for endpoint in endpoints:
        if not endpoint.startswith(right_ones):
            right = " or ".join(f"{start}..." for start in ENDPOINTS_OF_MODE[mode])
            raise BusError(f"{endpoint}: not under bus.security.mode = {mode!r}; {right} is right")
    found: dict[str, object] = {
        "transport/unicast/max_sessions": SESSIONS_MAX,
        "transport/link/rx/max_message_size": MESSAGE_MAX,
        "low_pass_filter": [_LOW_PASS],
    }
    if mode == "mtls":
        found |= _mutual_tls(robot, process)
    return found


_LOW_PASS: Final[dict[str, Any]] = {
    "id": "payloads",
    "flows": ["ingress"],
    "messages": ["put"],
    "key_exprs": ["**"],
    "size_limit": PAYLOAD_MAX,
}


def allow_robots_hosts(robot: RobotConfig, listening: Sequence[str]) -> None:
    """Under `mtls`, have this process hear the hosts of the endpoints and of `allow` only.

    A host whose name is not known now is left out, and told: its own link fails, and no other.

    Raises:
        BusError: the kernel takes no filter.
    """
    if robot.bus.security.mode != "mtls":
        return
    hosts = {host_and_port(endpoint)[0] for endpoint in robot.bus.endpoints.values()}
    ports = {host_and_port(each)[1] for each in listening if each.startswith(TCP)}
    if not ports:
        return
    addresses, unknown = allow_list.resolved([*hosts, *robot.bus.security.allow])
    for name in unknown:
        log.get("xrl").warning("%s: no such host now; what comes from it is dropped", name)
    allow_list.restrict(ports, addresses)


def listener(endpoint: str) -> str:
    """Return an endpoint to listen on as Zenoh takes it: a silent handshake is dropped soon."""
    of_tls = endpoint.startswith("tls/")
    return f"{endpoint}#tls_handshake_timeout_ms={HANDSHAKE_MS}" if of_tls else endpoint


def _mutual_tls(robot: RobotConfig, process: str) -> dict[str, object]:
    own = read_credentials(robot, process)
    certificate, key = str(own.certificate), str(own.key)
    return {
        "transport/link/protocols": ["tls", "unixsock-stream"],
        "transport/link/tls": {
            "root_ca_certificate": str(own.authority),
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            # An expiry must not cut a robot that stands; `xrl doctor` warns before.
            "close_link_on_expiration": False,
        },
        "access_control": access_control(
            robot.name, own.name, own.generations, held_names(own.authority.parent)
        ),
    }
