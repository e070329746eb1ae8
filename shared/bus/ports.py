"""Inboxes and outboxes of a service's loop.

In live operation they are `Latest` and `Publisher` of `shared.bus.pubsub`. In lockstep they are
modelled links, and in re-execution the log's messages.
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
    """Inbox that counts payloads that are not messages."""

    @property
    def refused(self) -> int:
        """Number of payloads so far that were not messages."""


class Outbox(Protocol[M_contra]):
    """Sender of one key's messages."""

    def put(self, message: M_contra, /) -> bool:
        """Send without waiting; return False if it could not be sent."""
