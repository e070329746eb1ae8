"""What a service's loop takes from the bus and puts on it, wherever it runs.

Live these are `Latest` and `Publisher` of `shared.bus.session`; in lockstep modelled links, in
re-execution what the log has.
"""

from __future__ import annotations

from typing import Protocol, TypeVar

from shared.bus.messages import Message

M = TypeVar("M", bound=Message)
M_co = TypeVar("M_co", bound=Message, covariant=True)
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)


class Inbox(Protocol[M_co]):
    """The newest message of one key."""

    def take(self) -> M_co | None:
        """Return the newest message if it was not taken before, else None; never blocks."""


class CountingInbox(Inbox[M_co], Protocol[M_co]):
    """An inbox that counts what came and was no message."""

    @property
    def refused(self) -> int:
        """Payloads so far that were none."""


class Outbox(Protocol[M_contra]):
    """Messages of one key."""

    def put(self, message: M_contra, /) -> bool:
        """Send without waiting; False if it could not be sent."""
