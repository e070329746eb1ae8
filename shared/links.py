"""Table of the links that can be impaired: those of commands, states, wrenches and attitudes.

A link is the connection of two processes (`shared.bus.session.peers_of`). Each of its directions is
named `SENDER->RECEIVER`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from shared.exceptions import ConfigError
from shared.joints import MODULES


class Pair(NamedTuple):
    """Two processes with a link."""

    dials: str
    listens: str

    @property
    def there(self) -> str:
        """Name of the direction from the process that dials."""
        return f"{self.dials}->{self.listens}"

    @property
    def back(self) -> str:
        """Name of the direction from the process that listens."""
        return f"{self.listens}->{self.dials}"


PAIRS: Final = (
    *(Pair("planner", module) for module in MODULES),
    Pair("harness", "planner"),
    Pair("imu", "planner"),
)

COMMANDS: Final = tuple(f"planner->{module}" for module in MODULES)
STATES: Final = tuple(f"{module}->planner" for module in MODULES)
WRENCHES: Final = "harness->planner"
ATTITUDES: Final = "imu->planner"
DIRECTIONS: Final = (*COMMANDS, *STATES, WRENCHES, ATTITUDES)
"""Every direction that can be impaired."""

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "planner->joints": COMMANDS,
    "joints->planner": STATES,
    "planner->right": tuple(name for name in COMMANDS if name.endswith("_right")),
    "planner->left": tuple(name for name in COMMANDS if name.endswith("_left")),
    "right->planner": tuple(name for name in STATES if "_right-" in name),
    "left->planner": tuple(name for name in STATES if "_left-" in name),
    "all": DIRECTIONS,
}
"""Names for several directions."""


def endpoint_through(pair: Pair) -> str:
    """Return the network proxy's endpoint for a pair, used instead of that in `bus.endpoints`."""
    return f"unixsock-stream/{{run}}/through-{pair.dials}-{pair.listens}.zenoh"


def directions_of(link: str, file: str = "--link", key: str = "link") -> tuple[str, ...]:
    """Return the directions that a name of `DIRECTIONS` or `GROUPS` stands for.

    Raises ConfigError, with the name's source `file` and `key`, for any other name.
    """
    if link in GROUPS:
        return GROUPS[link]
    if link in DIRECTIONS:
        return (link,)
    right = (
        f"use one of {', '.join(GROUPS)}, planner->MODULE, MODULE->planner, {WRENCHES}, {ATTITUDES}"
    )
    raise ConfigError(file, key, repr(link), right)
