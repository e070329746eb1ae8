"""A sensor on a CAN bus: the newest sample, without waiting for it."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final, Generic, TypeVar

import can

from shared.can.sensor_frames import FrameGroup
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig, expand
from shared.config.sections import HarnessConfig, ImuConfig
from shared.exceptions import ConfigError

S = TypeVar("S")

RETRY_NS: Final = 200 * NS_PER_MS
"""Minimum time between two attempts to open the link."""

DRAIN_MAX: Final = 1024
"""Maximum number of frames per read, so that a flooded bus cannot block the loop."""


class CanSensor(Generic[S]):
    """A sensor through python-can; reopens a lost link on its own."""

    def __init__(
        self, interface: str, channel: str, assembler: FrameGroup[S], *, pause_ns: int
    ) -> None:
        """Store the settings; the first `newest` opens the link.

        If more than `pause_ns` passes between two reads, because this process was stopped, the
        waiting frames are discarded: a full queue keeps its oldest frames, so their age is unknown.
        Raises ConfigError if python-can does not know the interface.
        """
        if interface not in can.VALID_INTERFACES:
            raise _unusable(interface, "python-can does not know this interface")
        self.opened = 0
        """Number of times the link was opened."""
        self.discarded = 0
        """Number of reads discarded because the frames' age was unknown: after a pause, or because
        the queue was not emptied."""
        self._interface = interface
        self._channel = channel
        self._pause_ns = pause_ns
        self._bus: can.BusABC | None = None
        self._assembler = assembler
        self._backlog = False
        self._retry_ns: int | None = None
        self._last_read_ns: int | None = None

    @property
    def connected(self) -> bool:
        """True while the link is open, as far as the last read could tell."""
        return self._bus is not None

    @property
    def malformed(self) -> int:
        """Number of sensor frames of a wrong length or out of order."""
        return self._assembler.malformed

    def newest(self, now_ns: int) -> S | None:
        """Return the newest sample that arrived since the last call, or None; never blocks.

        Never raises for a lost link; returns None until it is back.
        """
        last_ns, self._last_read_ns = self._last_read_ns, now_ns
        if self._bus is None:
            self._bus = self._open(now_ns)
        if self._bus is None:
            return None
        sample, emptied = self._drain(self._bus)
        paused = last_ns is not None and now_ns - last_ns > self._pause_ns
        of_unknown_age = paused or self._backlog or not emptied
        self._backlog = not emptied
        if of_unknown_age:
            self.discarded += 1
            self._assembler.reset()
            return None
        return sample

    def close(self) -> None:
        """Release the link; a later `newest` would open it again."""
        if self._bus is not None:
            # The link itself may be broken.
            with contextlib.suppress(can.CanError, OSError):
                self._bus.shutdown()
        self._bus = None
        self._assembler.reset()

    def _open(self, now_ns: int) -> can.BusABC | None:
        """Return the link, or None if it is missing or the last attempt was too recent.

        Raises ConfigError if the interface cannot be used on this machine, now or later.
        """
        if self._retry_ns is not None and now_ns < self._retry_ns:
            return None
        self._retry_ns = now_ns + RETRY_NS
        try:
            link = can.Bus(interface=self._interface, channel=self._channel, ignore_config=True)
        except can.CanInterfaceNotImplementedError as error:
            raise _unusable(self._interface, str(error)) from None
        except (can.CanError, OSError):
            return None
        self.opened += 1
        return link

    def _drain(self, link: can.BusABC) -> tuple[S | None, bool]:
        """Return the newest complete sample, and True if no frame is left in the queue."""
        newest: S | None = None
        for _ in range(DRAIN_MAX):
            try:
                frame = link.recv(timeout=0.0)
            except (can.CanError, OSError):
                self.close()
                return newest, True
            if frame is None:
                return newest, True
            if is_data_frame(frame):
                newest = self._assembler.add(frame.arbitration_id, frame.data) or newest
        return newest, False


def sensor_of(
    robot: RobotConfig,
    section: HarnessConfig | ImuConfig,
    assembler: FrameGroup[S],
    run_dir: Path,
) -> CanSensor[S]:
    """Return a sensor on the bus that its section of the robot file names."""
    link = robot.can[section.bus]
    # at a low rate reads are more than `stale_ms` apart: up to two periods are not a pause
    pause_ns = round(max(section.stale_ms * NS_PER_MS, 2.0 * NS_PER_S / section.rate_hz))
    return CanSensor(link.interface, expand(link.channel, run_dir), assembler, pause_ns=pause_ns)


def is_data_frame(message: can.Message) -> bool:
    """Return True for a standard data frame, the only kind that drives and sensors send.

    An error frame's id describes a fault of the bus, and an extended id may equal the standard one
    of another sender. A request is a remote frame, and so is its echo.
    """
    return not (message.is_error_frame or message.is_remote_frame or message.is_extended_id)


def _unusable(interface: str, why: str) -> ConfigError:
    right = f"use one of {', '.join(sorted(can.VALID_INTERFACES))}"
    return ConfigError("robot file", "can.*.interface", f"{interface!r}: {why}", right)
