"""Access rules of the bus under `mtls`: who may put and receive which key (docs/security.md).

Each process checks what its peers send by the name in their certificate: service and generation.
A peer of this host, by a UNIX socket, may do what any of the keys here allows: its user reads them.
The rules follow from the topics' columns `writers` and `readers`; what no rule allows is denied.
Zenoh has no list of revoked certificates: the rules name the current generation of each name only.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, Final

from shared.bus import topics
from shared.config.robot_config import SERVICES

PRINCIPALS: Final = (*SERVICES, topics.OPERATOR, topics.VIEWER)
"""Every name that a certificate can have under `mtls`; the network proxy is no part of it."""

_THIS_HOST: Final = "this-host"
_RECEIVED: Final = ("declare_subscriber",)
_TOKENS: Final = ("liveliness_token",)
_QUERIES: Final = ("liveliness_query", "declare_liveliness_subscriber")


def alive_prefix(robot: str) -> str:
    """Return what the keys of the liveliness tokens begin with."""
    return f"xrl/{robot}/alive"


def tools_prefix(robot: str) -> str:
    """Return what the keys of the tools' liveliness tokens begin with."""
    return f"{alive_prefix(robot)}/tool"


def token_key(robot: str, name: str, place: str = "") -> str:
    """Return the key of a process's liveliness token.

    Args:
        robot: its name.
        name: of the process.
        place: of a tool, where it runs: several have one name.
    """
    if name in SERVICES:
        return f"{alive_prefix(robot)}/{name}"
    return f"{tools_prefix(robot)}/{name}{place and f'.{place}'}"


def access_control(
    robot: str, own: str, generations: Mapping[str, int], held: Collection[str] = ()
) -> dict[str, Any]:
    """Return Zenoh's setting `access_control` of one process.

    Args:
        robot: its name.
        own: the process, one of `PRINCIPALS`.
        generations: the current generation of each certified name.
        held: names whose keys this host holds, which its UNIX sockets serve.
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
            # By receiver: until a new peer has told its subscriptions, Zenoh sends it everything.
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


def common_name(name: str, generation: int) -> str:
    """Return the name in a certificate, for example `planner.2`."""
    return f"{name}.{generation}"


def _token_keys(robot: str, name: str) -> tuple[str, ...]:
    if name in SERVICES:
        return (token_key(robot, name),)
    return (f"{tools_prefix(robot)}/*",)


def _rule(
    name: str, flow: str, messages: Iterable[str], keys: tuple[str, ...]
) -> dict[str, Any] | None:
    """Return a rule; None where there is nothing to allow, which Zenoh refuses as a rule."""
    if not keys:
        return None
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }
