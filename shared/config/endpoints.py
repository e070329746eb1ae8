"""Endpoints of the bus, and placeholders in configuration texts."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Final

from shared.exceptions import BusError

PORT_MAX: Final = 65_535
RUN: Final = "{run}"
"""Placeholder of the fleet's live directory, in endpoints and channels."""
ROBOT: Final = "{robot}"
"""Placeholder of the robot's name, in `bus.security.keys`."""
_UNIX: Final = re.compile(r"unixsock-stream/[^?#]+")
"""Zenoh reads text after ? or # as settings of the link, not as part of the path."""
_ADDRESS: Final = re.compile(
    r"(?:tcp|tls)/(\[[0-9A-Za-z:.%_-]+\]|[^\[\]:/]+):([0-9]{1,5})(?:[?#].*)?"
)
_PLACEHOLDER: Final = re.compile(r"\{[^{}]*\}")
_BRACES: Final = re.compile(r"\{[^{}]*\}?|\}")


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Return host and port of tcp/HOST:PORT or tls/[HOST]:PORT; raise BusError for other texts."""
    found = _ADDRESS.fullmatch(endpoint)
    if found is None or not 0 < int(found[2]) <= PORT_MAX:
        raise BusError(
            f"{endpoint}: not a host and port; use tcp/HOST:PORT with a port from 1 to {PORT_MAX}"
        )
    return found[1].strip("[]"), int(found[2])


def is_endpoint(text: str) -> bool:
    """Return True for unixsock-stream/PATH, and for tcp/HOST:PORT and tls/HOST:PORT."""
    if _UNIX.fullmatch(text):
        return True
    try:
        host_and_port(text)
    except BusError:
        return False
    return True


def filled(text: str, values: Mapping[str, str]) -> str:
    """Return a text with the placeholders in `values`, such as {run}, replaced; others remain."""
    return _PLACEHOLDER.sub(lambda found: values.get(found[0], found[0]), text)


def stray_braces(text: str, placeholders: Iterable[str]) -> str:
    """Return the first text in braces that is not a placeholder, such as `{Run}`; else ""."""
    found = _BRACES.search(filled(text, dict.fromkeys(placeholders, "")))
    return found[0] if found else ""
