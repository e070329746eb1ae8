"""Requests to the network proxy on its socket, and its replies: one JSON line each."""

from __future__ import annotations

from typing import Final, TypeAlias

import msgspec

from shared.config.scenarios import Inject
from shared.links import directions_of

SOCKET: Final = "network_proxy.sock"
"""Name of the socket in the live directory of the fleet."""
LINE_MAX: Final = 65536


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """Request: start an impairment, now or later; `inject.at` is ignored."""

    inject: Inject
    in_s: float = 0.0
    """Delay before the start, s; the network proxy waits, not the client."""


class Clear(msgspec.Struct, frozen=True, tag="clear"):
    """Request: end the impairments that affect a link, started or planned."""

    link: str = "all"


class List(msgspec.Struct, frozen=True, tag="list"):
    """Request: list the impairments."""


Request: TypeAlias = Begin | Clear | List


class RequestedImpairment(msgspec.Struct, frozen=True):
    """One requested impairment that is not over."""

    number: int
    link: str
    detail: str
    """The impairment, in the syntax of `--inject`."""
    left_s: float | None
    """Time until it ends, s; None: no end."""
    passed: int
    """Messages (Zenoh batches) that passed while it was active."""
    lost: int
    """Messages (Zenoh batches) that were lost while it was active."""
    in_s: float = 0.0
    """Time until it begins, s; 0: it has begun."""
    hidden: tuple[str, ...] = ()
    """Directions on which another impairment is active instead
    (`shared.config.impairment.Direction`)."""

    def standing(self) -> str:
        """Return why it is not active, and on how many directions; empty if it is active."""
        if self.in_s:
            return f"in {self.in_s:.1f} s"
        if not self.hidden:
            return ""
        count = len(directions_of(self.link))
        return "hidden" if len(self.hidden) == count else f"hidden on {len(self.hidden)} of {count}"

    def describe(self) -> str:
        """Return its link, its impairment and, if it is not active, why."""
        standing = self.standing()
        return f"{self.link} {self.detail}{f' ({standing})' if standing else ''}"


class Reply(msgspec.Struct, frozen=True):
    """Reply to every request."""

    error: str = ""
    requested: tuple[RequestedImpairment, ...] = ()
    """Impairments after the request was carried out, the newest last."""
