"""CAN link over python-can, for the drivers: it survives failures of the bus, and reconnects."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, TypeAlias

import can

from services.joint.drivers.bus_watch import ASK_AFTER_NS, BusWatch
from shared.can import cansimple
from shared.can.cansimple import Command
from shared.can.cansimple_06 import Command06
from shared.can.interface import limit_queue, restart
from shared.can.unix_can import (
    ERROR_FLAG,
    EXTENDED_FLAG,
    FRAME_BYTES,
    REMOTE_FLAG,
    STANDARD_MASK,
    Frame,
    UnixCanBus,
    pack_frame,
    unpack_frames,
)
from shared.clock import NS_PER_MS, now_ns
from shared.config.sections import CanConfig
from shared.exceptions import DriveError

FRAMES_PER_READ: Final = 512
"""Maximum number of frames per read, more than a socket holds: a flood must not delay the loop."""
RETRY_MS: Final = 200
"""Time between two attempts to open the bus, ms: on socketcan an attempt may cost 1 ms."""
COMMANDS_MS: Final = 40
"""Time after which a command that the bus has not accepted is dropped as outdated, ms."""
ECHOING: Final = ("socketcan", "xrl_unix")
"""Interfaces that return our frames once the bus has carried them."""
ECHOED: Final = (Command.SET_INPUT_POS, Command.SET_INPUT_TORQUE, Command06.GET_VERSION)
"""Commands to axis0 whose echo is awaited; each packet of targets or torques contains one."""
HEARD: Final = (
    Command.HEARTBEAT,
    Command.GET_ENCODER_ESTIMATES,
    Command.GET_ENCODER_COUNT,
    Command.GET_IQ,
    Command.GET_VBUS,
    Command06.GET_TEMPERATURE,
)
"""Messages that the drive sends; they show that it is on, and pass the kernel's filter."""
IN_KERNEL: Final = ("socketcan",)
"""Interfaces whose frames all wait in the kernel, behind one file descriptor for `select`. The
kernel drops other modules' frames before it wakes a process for them."""

BUS_OFF: Final = 0x40
"""Class of an error frame (linux/can/error.h): the controller has left the bus."""

Receive: TypeAlias = Callable[[float], bytes]
"""Waits for at most the given seconds and returns all received frames, packed."""
Send: TypeAlias = Callable[[bytes], int]
"""Sends packed frames; returns how many bytes, from the first, the bus has accepted."""


def packed(node_id: int, command: int, data: bytes) -> bytes:
    """Return a frame to a node, packed as SocketCAN does."""
    return pack_frame(cansimple.arbitration_id(node_id, command), len(data), data)


def request_of(node_id: int, command: int) -> bytes:
    """Return a request for a node's answer to a command, packed."""
    return pack_frame(cansimple.arbitration_id(node_id, command) | REMOTE_FLAG, 8, b"")


class CanLink:
    """A bus that may be absent: its failures look like silence.

    If the bus fails, or its controller goes bus-off (too many errors on the wire), the link closes
    it and tries to reopen it every `RETRY_MS`. It sends no frame that would have to wait for a node
    to acknowledge it (`services.joint.drivers.bus_watch`).

    Attributes:
        watch: state of the bus.
        bus_offs: number of times that the controller went bus-off.
        error_frames: number of reports of other errors on the wire.
    """

    def __init__(self, config: CanConfig, node_ids: Sequence[int]) -> None:
        """Set the bus, with `{run}` in its channel already expanded, and the nodes to listen to."""
        self.bus_offs = 0
        self.error_frames = 0
        self._config = config
        self._options: dict[str, Any] = {}
        if config.interface in IN_KERNEL:
            self._options["can_filters"] = filters(node_ids)
        echoes = config.interface in ECHOING
        if echoes:
            self._options["receive_own_messages"] = True
        self.watch = BusWatch(echoes=echoes)
        self._own = {cansimple.arbitration_id(node_ids[0], command) for command in ECHOED}
        self._drives = {
            cansimple.arbitration_id(node, command) for node in node_ids for command in HEARD
        }
        self._probe = packed(node_ids[0], Command06.GET_VERSION, b"")
        self._greeting = b""
        self._bus: can.BusABC | None = None
        self._receive: Receive = _nothing
        self._send: Send = _drop
        self._carried: Callable[[], bytes] | None = None
        self._retry_at_ns = 0
        self._commands = b""
        self._commands_until_ns = 0
        self._commands_proven = False

    @property
    def is_open(self) -> bool:
        """True while the bus is open."""
        return self._bus is not None

    def connect(self) -> bool:
        """Open the bus, at most once every `RETRY_MS`; return True if it was opened.

        Raises:
            DriveError: python-can does not know the interface.
        """
        now = now_ns()
        if now < self._retry_at_ns:
            return False
        self._retry_at_ns = now + RETRY_MS * NS_PER_MS
        try:
            self._bus = can.Bus(
                interface=self._config.interface,
                channel=self._config.channel,
                ignore_config=True,  # python-can would read its own files at every attempt
                **self._options,
            )
        except NotImplementedError as error:
            raise DriveError(
                f"CAN interface {self._config.interface!r}: {error}; "
                "use an interface that python-can knows, such as socketcan or xrl_unix"
            ) from error
        except (can.CanError, OSError):
            return False
        self.watch.reopened()
        with suppress(OSError):
            limit_queue(self._bus)
        in_kernel = self._config.interface in IN_KERNEL
        self._receive = receiver(self._bus, in_kernel=in_kernel)
        self._send = sender(self._bus, in_kernel=in_kernel)
        self._carried = self._bus.carried if isinstance(self._bus, UnixCanBus) else None
        return True

    def receive(self, timeout_s: float) -> list[Frame]:
        """Return the frames of one wait; empty if there are none, or if the bus failed.

        They include error frames, for `error_frame`.
        """
        frames = unpack_frames(self.receive_packet(timeout_s))
        self.take_in(frames, now_ns())
        return frames

    def receive_packet(self, timeout_s: float) -> bytes:
        """Return frames as `receive` does, but packed; `take_in` or `hear_drive` must follow."""
        if self._commands:
            self._send_commands()
        try:
            packet = self._receive(timeout_s)
            off = not packet and self._bus is not None and self._bus.state is can.BusState.ERROR
        except (can.CanError, OSError):
            self._disconnect()
            return b""
        if off:
            self._go_off()
        return packet

    def take_in(self, frames: Sequence[Frame], now: int) -> None:
        """Update the state of the bus from frames; discard frames that must no longer wait."""
        watch = self.watch
        for can_id, _ in frames:
            if can_id in self._drives:
                watch.received(now)
            elif can_id in self._own:
                watch.carried(now)
        self._look_after(now)

    def hear_drive(self, now: int) -> None:
        """Do the same as `take_in`, for frames that all come from the drive."""
        if not self.watch.heard_in_order(now) or self._commands or self._greeting:
            self._look_after(now)

    def error_frame(self, can_id: int) -> None:
        """Process an error frame; after a bus-off the bus is closed."""
        if can_id & BUS_OFF:
            self._go_off()
        else:
            self.error_frames += 1

    def send(self, packet: bytes, awaited: int = 0) -> bool:
        """Send frames; return False if the bus did not accept them all.

        Frames from `order` that still wait are sent first; nothing else is sent before them.

        Args:
            packet: the frames.
            awaited: number of `ECHOED` frames to axis0 among them.
        """
        if self._commands and not self._send_commands():
            return False
        # False also covers a full queue; a dead link is detected when receiving.
        return self._hand_over(packet, awaited, now_ns()) == len(packet)

    def greet(self, packet: bytes) -> None:
        """Send the first requests on a newly opened bus.

        They do not wait for a frame from the drive: their echoes show whether the bus has a node,
        and whether frames of an earlier process wait. After an outage they wait until the drive
        sends.
        """
        if self.watch.unacknowledged:
            self._greeting = packet
        else:
            self._send(packet)
            self._send_probe(now_ns())

    def order(self, packet: bytes, *, proven: bool = False) -> None:
        """Send all frames, in this order.

        A dozen frames may exceed the queue of the interface (ten frames by default). The others
        are sent when there is room, within `COMMANDS_MS`. The frames replace a command that still
        waits.

        Args:
            packet: the frames.
            proven: send them only if the bus has just carried a frame, because a delayed request
                would arm a drive at the wrong time.
        """
        if self._bus is None:
            return
        self._commands = packet + self._probe if proven and self.watch.echoes else packet
        self._commands_until_ns = now_ns() + COMMANDS_MS * NS_PER_MS
        self._commands_proven = proven
        self._send_commands()

    def close(self) -> None:
        """Close the bus for good."""
        self._disconnect()
        self._retry_at_ns = 1 << 63

    def _send_commands(self) -> bool:
        """Send as many frames as the bus has room for; True if none is left."""
        now, waiting = now_ns(), self._commands
        if now > self._commands_until_ns:
            self._commands = b""
        elif not self._commands_proven or self.watch.may_arm(now):
            self._commands = waiting[self._hand_over(waiting, self._awaited(waiting), now) :]
        elif self.watch.may_send(now) and not self.watch.waits:
            self._send_probe(now)
        return not self._commands

    def _hand_over(self, packet: bytes, awaited: int, now: int) -> int:
        """Send frames if they need not wait; return the number of bytes that the bus accepted."""
        watch = self.watch
        if not watch.may_send(now):
            return 0
        taken = self._send(packet)
        if not watch.echoes:
            return taken
        if taken < len(packet):
            awaited = self._awaited(packet[:taken])
            # a refused request proves nothing: it has no echo, and later frames prove more
            if not all(can_id & REMOTE_FLAG for can_id, _ in unpack_frames(packet[taken:])):
                watch.refused(now)
        for _ in range(awaited):
            watch.sent(now)
        return taken

    def _awaited(self, packet: bytes) -> int:
        """Return how many frames of a packet have an awaited echo."""
        return sum(can_id in self._own for can_id, _ in unpack_frames(packet))

    def _send_probe(self, now: int) -> None:
        """Send a frame that changes nothing; its echo shows that the bus carries frames."""
        if self._send(self._probe):
            self.watch.sent(now)

    def _look_after(self, now: int) -> None:
        """Query the frames that the bus has carried; restart, probe or greet it if that is due."""
        watch = self.watch
        if self._bus is None:
            return
        if self._carried is not None and (
            self._commands or watch.unacknowledged or watch.waited_ns(now) >= ASK_AFTER_NS
        ):
            for _ in range(self._awaited(self._carried())):
                watch.carried(now)
        if watch.restart_due(now):
            self._restart()
        elif watch.probe_due(now):
            self._send_probe(now)
        elif self._greeting and watch.may_send(now):
            self._greeting, greeting = b"", self._greeting
            self._send(greeting)

    def _restart(self) -> None:
        """Discard all processes' frames that wait in the kernel and the adapter."""
        self._commands = b""
        done = True
        try:
            restart(self._bus, self._config.channel)
        except OSError:
            done = False
        self.watch.restarted(now_ns(), done=done)

    def _go_off(self) -> None:
        self.bus_offs += 1
        self._disconnect()
        self._retry_at_ns = now_ns() + RETRY_MS * NS_PER_MS

    def _disconnect(self) -> None:
        """Close the bus, and drop a waiting command."""
        if self._bus is not None:
            with suppress(can.CanError, OSError):
                self._bus.shutdown()
        self._bus = None
        self._receive = _nothing
        self._send = _drop
        self._carried = None
        self._commands = b""


def filters(node_ids: Sequence[int]) -> list[dict[str, Any]]:
    """Return python-can's filters for drives' frames and our frames whose echo is awaited.

    Error frames pass the filters.
    """
    mask = cansimple.arbitration_id(cansimple.NODE_MASK, cansimple.COMMAND_MASK)
    wanted = [(node, command) for node in node_ids for command in (*HEARD, Command06.GET_VERSION)]
    wanted += [(node_ids[0], command) for command in ECHOED[:-1]]
    return [
        {
            "can_id": cansimple.arbitration_id(node, command),
            "can_mask": mask,
            "extended": False,
        }
        for node, command in wanted
    ]


def receiver(bus: can.BusABC, *, in_kernel: bool) -> Receive:
    """Return a function that waits once on a bus, then receives all available frames.

    A kernel bus is read at its socket, because python-can creates an object for each frame, and
    waits by the wall clock. If NTP set that clock back, a silent bus would block the loop.
    """
    if isinstance(bus, UnixCanBus):
        return bus.recv_packet
    raw = getattr(bus, "socket", None) if in_kernel else None
    if isinstance(raw, socket.socket):

        def read(timeout_s: float) -> bytes:
            if not select.select((raw,), (), (), timeout_s)[0]:
                return b""
            packet = b""
            for _ in range(FRAMES_PER_READ):
                try:
                    packet += raw.recv(FRAME_BYTES, socket.MSG_DONTWAIT)
                except BlockingIOError:
                    break
            return packet

        return read

    def receive(timeout_s: float) -> bytes:
        packet = b""
        for _ in range(FRAMES_PER_READ):
            message = bus.recv(timeout_s)
            if message is None:
                break
            timeout_s = 0.0
            if not message.is_remote_frame or message.is_error_frame:
                flags = ERROR_FLAG * message.is_error_frame | EXTENDED_FLAG * message.is_extended_id
                packet += pack_frame(message.arbitration_id | flags, message.dlc, message.data)
        return packet

    return receive


def sender(bus: can.BusABC, *, in_kernel: bool) -> Send:
    """Return a function that sends several frames, up to the first that the bus does not accept."""
    if isinstance(bus, UnixCanBus):
        return bus.send_packet
    raw = getattr(bus, "socket", None) if in_kernel else None

    def send(packet: bytes) -> int:
        for at in range(0, len(packet), FRAME_BYTES):
            frame = packet[at : at + FRAME_BYTES]
            try:
                if not isinstance(raw, socket.socket):
                    bus.send(_message(frame), timeout=0.0)
                elif not select.select((), (raw,), (), 0.0)[1]:
                    return at  # more than limit_queue allows is on its way
                else:
                    raw.send(frame, socket.MSG_DONTWAIT)
            except (can.CanError, OSError):
                return at
        return len(packet)

    return send


def _message(frame: bytes) -> can.Message:
    """Convert a packed frame to python-can's message."""
    ((can_id, data),) = unpack_frames(frame)
    remote = bool(can_id & REMOTE_FLAG)
    return can.Message(
        arbitration_id=can_id & STANDARD_MASK,
        is_remote_frame=remote,
        dlc=len(data),
        data=None if remote else data,
        is_extended_id=False,
    )


def _nothing(_timeout_s: float) -> bytes:
    """Receive without a bus."""
    return b""


def _drop(_packet: bytes) -> int:
    """Send without a bus."""
    return 0
