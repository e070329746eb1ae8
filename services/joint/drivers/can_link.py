"""A CAN link by python-can as the drivers use it: many frames at a call, or none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

import can

from shared import cansimple

FRAMES_PER_READ: Final = 512
"""More than can wait in a socket; a flooded bus must not hold up the loop."""

Frame: TypeAlias = tuple[int, bytes]
"""Arbitration id and payload."""
Receive: TypeAlias = Callable[[float], Sequence[Frame]]
"""Waits for at most so many seconds and returns all that is there."""
Send: TypeAlias = Callable[[Sequence[can.Message]], None]


def message(node_id: int, command: int, data: bytes) -> can.Message:
    """Return a frame to a node."""
    return can.Message(
        arbitration_id=cansimple.arbitration_id(node_id, command), data=data, is_extended_id=False
    )


def request_of(node_id: int, command: int) -> can.Message:
    """Return a request for a node's answer to a command."""
    return can.Message(
        arbitration_id=cansimple.arbitration_id(node_id, command),
        is_remote_frame=True,
        dlc=8,
        is_extended_id=False,
    )


def nothing(_timeout_s: float) -> Sequence[Frame]:
    """Receive without a bus."""
    return ()


def drop(_messages: Sequence[can.Message]) -> None:
    """Send without a bus."""


def receiver(bus: can.BusABC) -> Receive:
    """Return the bus's `recv_many`, or one made for it: one wait, then all that is there."""
    ready: Receive | None = getattr(bus, "recv_many", None)
    if ready is not None:
        return ready

    def receive(timeout_s: float) -> Sequence[Frame]:
        frames: list[Frame] = []
        message = bus.recv(timeout_s)
        while message is not None:
            if not message.is_error_frame and not message.is_remote_frame:
                frames.append((message.arbitration_id, bytes(message.data)))
            if len(frames) >= FRAMES_PER_READ:
                break
            message = bus.recv(0.0)
        return frames

    return receive


def sender(bus: can.BusABC) -> Send:
    """Return the bus's `send_many`, or one made for it."""
    ready: Send | None = getattr(bus, "send_many", None)
    if ready is not None:
        return ready

    def send(messages: Sequence[can.Message]) -> None:
        for message in messages:
            bus.send(message, timeout=0.0)

    return send
