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
    """Put an impairment in force, now or soon; `at` of it is not looked at."""

    inject: Inject
    in_s: float = 0.0
    """From now, s; the network proxy waits, not the one that asks."""


class Clear(msgspec.Struct, frozen=True, tag="clear"):
    """Request: end the impairments of a link, started or planned."""

    link: str = "all"


class List(msgspec.Struct, frozen=True, tag="list"):
    """Request: list the impairments."""


Request: TypeAlias = Begin | Clear | List


class RequestedImpairment(msgspec.Struct, frozen=True):
    """One requested impairment that is not over."""

    number: int
    link: str
    detail: str
    """The impairment, as `--inject` takes it."""
    left_s: float | None
    """Until it ends, s from now; None: it does not by itself."""
    passed: int
    """Messages (batches of Zenoh's) while it was in force."""
    lost: int
    """Messages among them that were lost."""
    in_s: float = 0.0
    """Until it begins, s from now; 0: it has."""
    hidden: tuple[str, ...] = ()
    """Its directions on which another one is in force (`shared.config.impairment.Direction`)."""

    def standing(self) -> str:
        """Return what keeps it from being done now, and where; empty if nothing does."""
        if self.in_s:
            return f"in {self.in_s:.1f} s"
        if not self.hidden:
            return ""
        count = len(directions_of(self.link))
        return "hidden" if len(self.hidden) == count else f"hidden on {len(self.hidden)} of {count}"

    def describe(self) -> str:
        """Return where it is, what, and what keeps it from being done now."""
        standing = self.standing()
        return f"{self.link} {self.detail}{f' ({standing})' if standing else ''}"


class Reply(msgspec.Struct, frozen=True):
    """The answer to every request."""

    error: str = ""
    requested: tuple[RequestedImpairment, ...] = ()
    """Impairments after the request was carried out, the newest last."""
