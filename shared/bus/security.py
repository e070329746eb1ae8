"""Access to the bus, and the messages that each peer may put and receive (docs/security.md).

Zenoh's settings follow from `bus.security.mode`. Under `mtls` each process checks the messages of
its peers by the name in their certificate: service and generation. The rules follow from the
topics' columns `writers` and `readers`; everything else is denied. Zenoh has no list of revoked
certificates, so the rules contain only the current generation of each name.

Services of one host are linked by UNIX sockets, because anyone who reaches a TLS port can block new
links there (`shared.bus.sockets`). Only this user can open a socket in the live directory. A peer
on such a socket has the rights of all certificates on this host, because its user can read their
keys.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Final

from shared.bus import sockets, topics
from shared.bus.credentials import held_names, keys_folder, read_credentials
from shared.config.endpoints import host_and_port
from shared.config.robot_config import ENDPOINTS_OF_MODE, SERVICES, RobotConfig
from shared.exceptions import BusError

UNIX: Final = "unixsock-stream/"
TCP: Final = ("tcp/", "tls/")

MESSAGE_MAX: Final = 1 << 20
"""Maximum size of a message assembled from fragments, bytes."""
PAYLOAD_MAX: Final = 1 << 16
"""Maximum accepted payload, bytes; the largest payload of any topic is a third of this."""
HANDSHAKE_MS: Final = 2_000
"""Timeout of a TLS handshake at a listener; Zenoh's own is 10 s."""
SESSIONS_MAX: Final = 128
"""Maximum number of peers in total; hung viewers must not lock out a planner."""

_LOW_PASS: Final[dict[str, Any]] = {
    "id": "payloads",
    "flows": ["ingress"],
    "messages": ["put"],
    "key_exprs": ["**"],
    "size_limit": PAYLOAD_MAX,
}
_SOCKET: Final = "unixsock-stream/{{run}}/{service}.zenoh"
_ANY_PORT: Final = 9
"""Port for looking up a route; nothing is sent to it."""
_THIS_HOST: Final = "this-host"
_RECEIVED: Final = ("declare_subscriber",)
_TOKENS: Final = ("liveliness_token",)
_QUERIES: Final = ("liveliness_query", "declare_liveliness_subscriber")


def settings(robot: RobotConfig, process: str, endpoints: Sequence[str]) -> dict[str, object]:
    """Return Zenoh's access settings for a process.

    `endpoints` are all endpoints that the process listens on or dials, in Zenoh's form. Raises
    BusError if an endpoint does not fit the mode, or a key is missing.
    """
    mode = robot.bus.security.mode
    right_ones = ENDPOINTS_OF_MODE[mode] + ((UNIX,) if mode == "mtls" else ())
    for endpoint in endpoints:
        if not endpoint.startswith(right_ones):
            right = " or ".join(f"{start}..." for start in ENDPOINTS_OF_MODE[mode])
            raise BusError(f"{endpoint}: not allowed if bus.security.mode = {mode!r}; use {right}")
    found: dict[str, object] = {
        "transport/unicast/max_sessions": SESSIONS_MAX,
        "transport/link/rx/max_message_size": MESSAGE_MAX,
        "low_pass_filter": [_LOW_PASS],
    }
    if mode == "mtls":
        found |= _mutual_tls(robot, process)
    return found


def _mutual_tls(robot: RobotConfig, process: str) -> dict[str, object]:
    own = read_credentials(robot, process)
    certificate, key = str(own.certificate), str(own.key)
    held = held_names(own.authority.parent)
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
            # An expiry must not cut off a standing robot; `xrl doctor` warns before it.
            "close_link_on_expiration": False,
        },
        "access_control": access_control(robot.name, own.name, own.generations, held),
    }


def listener(endpoint: str) -> str:
    """Return a listening endpoint in Zenoh's form; for TLS, with a handshake timeout."""
    of_tls = endpoint.startswith("tls/")
    return f"{endpoint}#tls_handshake_timeout_ms={HANDSHAKE_MS}" if of_tls else endpoint


def limit_queues(robot: RobotConfig, listening: Sequence[str]) -> None:
    """Under `mtls`, limit this process's ports to one waiting connection at a time."""
    if robot.bus.security.mode == "mtls":
        ports = {host_and_port(each)[1] for each in listening if each.startswith(TCP)}
        sockets.shorten_queues(ports)


# ---- access rules


def access_control(
    robot: str, own: str, generations: Mapping[str, int], held: Collection[str] = ()
) -> dict[str, Any]:
    """Return Zenoh's setting `access_control` for a process whose name `own` is in `PRINCIPALS`.

    `generations` are the current generations of all certified names; `held` are the names whose
    keys this host has, and which its UNIX sockets therefore admit.
    """
    shown = (f"{alive_prefix(robot)}/*", f"{tools_prefix(robot)}/*")
    rules = [
        _rule("subscribe", "egress", _RECEIVED, topics.read_keys(robot, own)),
        _rule("show-me", "egress", _TOKENS, _token_keys(robot, own)),
        _rule("look-round", "egress", _QUERIES, shown),
        _rule("be-looked-at", "ingress", _QUERIES, shown),
    ]
    everybody = [rule["id"] for rule in rules if rule is not None]
    subjects: list[dict[str, Any]] = []
    policies, here = [], set(everybody)
    for name, generation in generations.items():
        own_rules = [
            # By receiver: Zenoh sends a peer everything until it knows that peer's subscriptions.
            _rule(f"to-{name}", "egress", ("put",), topics.keys_between(robot, own, name)),
            _rule(f"{name}-puts", "ingress", ("put",), topics.written_keys(robot, name)),
            _rule(f"{name}-subscribes", "ingress", _RECEIVED, topics.read_keys(robot, name)),
            _rule(f"{name}-shows", "ingress", _TOKENS, _token_keys(robot, name)),
        ]
        rules += own_rules
        subjects.append({"id": name, "cert_common_names": [common_name(name, generation)]})
        own_ids = [rule["id"] for rule in own_rules if rule is not None]
        policies.append({"rules": [*everybody, *own_ids], "subjects": [name]})
        here.update(own_ids if name in held else ())
    if held:
        subjects.append({"id": _THIS_HOST, "link_protocols": ["unixsock-stream"]})
        policies.append({"rules": sorted(here), "subjects": [_THIS_HOST]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for rule in rules if rule is not None],
        "subjects": subjects,
        "policies": policies,
    }


def _rule(
    name: str, flow: str, messages: Iterable[str], keys: tuple[str, ...]
) -> dict[str, Any] | None:
    """Return a rule, or None without keys: Zenoh refuses an empty rule."""
    if not keys:
        return None
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


def common_name(name: str, generation: int) -> str:
    """Return the name in a certificate, for example `planner.2`."""
    return f"{name}.{generation}"


def alive_prefix(robot: str) -> str:
    """Return the prefix of the liveliness tokens' keys."""
    return f"xrl/{robot}/alive"


def tools_prefix(robot: str) -> str:
    """Return the key prefix of the liveliness tokens of all tools."""
    return f"{alive_prefix(robot)}/tool"


def token_key(robot: str, name: str, place: str = "") -> str:
    """Return the key of a process's liveliness token; `place` tells tools of one name apart."""
    if name in SERVICES:
        return f"{alive_prefix(robot)}/{name}"
    return f"{tools_prefix(robot)}/{name}{place and f'.{place}'}"


def _token_keys(robot: str, name: str) -> tuple[str, ...]:
    if name in SERVICES:
        return (token_key(robot, name),)
    return (f"{tools_prefix(robot)}/*",)


# ---- services of one host


def services_here(robot: RobotConfig) -> frozenset[str]:
    """Return the services of this host: those whose keys it has and whose address is its own.

    Empty unless `bus.security.mode` is `mtls` and this host has keys. A name lookup may block, so
    call this only at start-up.
    """
    if robot.bus.security.mode != "mtls":
        return frozenset()
    try:
        held = held_names(keys_folder(robot))
    except BusError:
        return frozenset()  # `open_session` raises without them
    return frozenset(s for s in robot.services if s in held and _is_own(robot.bus.endpoints[s]))


def endpoint_here(robot: RobotConfig, service: str, here: frozenset[str]) -> str:
    """Return a service's endpoint for a process of this host; `here` is from `services_here`."""
    return _SOCKET.format(service=service) if service in here else robot.bus.endpoints[service]


def listening(robot: RobotConfig, service: str, here: frozenset[str]) -> tuple[str, ...]:
    """Return the endpoints on which a service of this host listens.

    A service with a UNIX socket also listens on its TLS port if another host may link to it.
    """
    own = endpoint_here(robot, service, here)
    public = robot.bus.endpoints[service]
    # A fleet starts its own simulator; the hosts of a real robot have no key for it.
    others = set(robot.services) - here - {"simulator"}
    return (own, public) if own != public and (others or robot.bus.security.allow) else (own,)


def _is_own(endpoint: str) -> bool:
    """Return True if an endpoint's host is this one. Nothing is sent."""
    return any(map(_is_own_address, sockets.addresses_of(host_and_port(endpoint)[0])))


def _is_own_address(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Return True if the route to an address begins at that address.

    Binding proves nothing: with `net.ipv4.ip_nonlocal_bind` any address can be bound.
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
