"""What a simulated sensor needs of its CAN bus."""

from __future__ import annotations

from typing import Protocol


class FrameHub(Protocol):
    """The sensor's end of its simulated CAN bus."""

    def poll(self) -> object:
        """Admit new clients and take what they sent; never waits."""

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        """Send frames (id, data) to every client, as one packet."""
