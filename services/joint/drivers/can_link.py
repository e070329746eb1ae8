"""A CAN link by python-can as the drivers use it: it never blocks, never raises, comes back."""

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
"""More than can wait in a socket; a flooded bus must not hold up the loop."""
RETRY_MS: Final = 200
"""Between two attempts to open the bus: on socketcan an attempt may cost a millisecond."""
COMMANDS_MS: Final = 40
"""An order that the bus has not taken by then is given up: it belongs to another moment."""
ECHOING: Final = ("socketcan", "xrl_unix")
"""Interfaces that hand own frames back once the bus has carried them."""
ECHOED: Final = (Command.SET_INPUT_POS, Command.SET_INPUT_TORQUE, Command06.GET_VERSION)
"""Commands to axis0 that are awaited back: each row that a driver sends has one of them."""
HEARD: Final = (
    Command.HEARTBEAT,
    Command.GET_ENCODER_ESTIMATES,
    Command.GET_ENCODER_COUNT,
    Command.GET_IQ,
    Command.GET_VBUS,
    Command06.GET_TEMPERATURE,
)
"""Commands whose frames are the drive's own: it is there, and the kernel lets them through."""
IN_KERNEL: Final = ("socketcan",)
"""Interfaces whose frames all wait in the kernel, behind one file descriptor: it throws other
modules' frames away before a process is woken for them, and is waited for by `select`."""

BUS_OFF: Final = 0x40
"""Class of an error frame (linux/can/error.h): the controller has left the bus."""

Receive: TypeAlias = Callable[[float], bytes]
"""Waits for at most the given seconds and returns all received frames, packed."""
Send: TypeAlias = Callable[[bytes], int]
"""Takes packed frames; returns how many bytes of them, from the first, the bus has taken."""


def packed(node_id: int, command: int, data: bytes) -> bytes:
    """Return a frame to a node, packed as SocketCAN does."""
    return pack_frame(cansimple.arbitration_id(node_id, command), len(data), data)


def request_of(node_id: int, command: int) -> bytes:
    """Return a request for a node's answer to a command, packed."""
    return pack_frame(cansimple.arbitration_id(node_id, command) | REMOTE_FLAG, 8, b"")


class CanLink:
    """A bus that may not be there: what goes wrong on it is counted, and reads as silence.

    A bus that fails, or whose controller has gone off it (too many errors on the wire), is
    closed, and opened again every `RETRY_MS`. Nothing is sent that would have to wait for somebody
    to acknowledge it (`services.joint.drivers.bus_watch`).

    Attributes:
        watch: what is known of the bus.
        bus_offs: how often the controller went off the bus.
        error_frames: reports of any other trouble on the wire.
    """

    def __init__(self, config: CanConfig, node_ids: Sequence[int]) -> None:
        """Take the channel with `{run}` already expanded, and the nodes to listen to."""
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
        """True while there is a bus."""
        return self._bus is not None

    def connect(self) -> bool:
        """Open the bus, not more often than every `RETRY_MS`; return True if it was.

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
                "use one that python-can knows, such as socketcan or xrl_unix"
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
        """Return the frames of one wait; none, too, if the bus failed, which closes it.

        Error frames are among them: they are for `error_frame`.
        """
        frames = unpack_frames(self.receive_packet(timeout_s))
        self.take_in(frames, now_ns())
        return frames

    def receive_packet(self, timeout_s: float) -> bytes:
        """As `receive`, but packed; `take_in` or `hear_drive` must follow."""
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
        """Take in what frames show of the bus; throw away what must not wait any longer."""
        watch = self.watch
        for can_id, _ in frames:
            if can_id in self._drives:
                watch.heard(now)
            elif can_id in self._own:
                watch.carried(now)
        self._look_after(now)

    def hear_drive(self, now: int) -> None:
        """As `take_in`, of frames that are all the drive's."""
        if not self.watch.heard_in_order(now) or self._commands or self._greeting:
            self._look_after(now)

    def error_frame(self, can_id: int) -> None:
        """Take in an error frame: a bus that is off is closed."""
        if can_id & BUS_OFF:
            self._go_off()
        else:
            self.error_frames += 1

    def send(self, packet: bytes, awaited: int = 0) -> bool:
        """Hand frames to the bus; False if it did not take them all.

        What waits by `order` goes first; until it has gone, nothing else goes.

        Args:
            packet: the frames.
            awaited: how many of them are `ECHOED` ones to axis0.
        """
        if self._commands and not self._send_commands():
            return False
        # A full queue comes here too. A dead link shows in receiving.
        return self._hand_over(packet, awaited, now_ns()) == len(packet)

    def greet(self, packet: bytes) -> None:
        """Send the first requests on a newly opened bus.

        They go before the drive was heard: whether they are carried shows if anybody is there, and
        whether frames wait from an earlier process. After an outage they wait for the drive.
        """
        if self.watch.unacknowledged:
            self._greeting = packet
        else:
            self._send(packet)
            self._send_probe(now_ns())

    def order(self, packet: bytes, *, proven: bool = False) -> None:
        """Send frames of which none may be missing, in this order.

        A row of a dozen can be longer than the queue of the interface (ten frames, unless
        set): the rest follows when there is room, within `COMMANDS_MS`. They take the place
        of an order that is still waiting.

        Args:
            packet: the row.
            proven: send it only once the bus has just carried a frame: an arming request that had
                to wait would arm a drive at another time.
        """
        if self._bus is None:
            return
        self._commands = packet + self._probe if proven and self.watch.echoes else packet
        self._commands_until_ns = now_ns() + COMMANDS_MS * NS_PER_MS
        self._commands_proven = proven
        self._send_commands()

    def close(self) -> None:
        """Leave the bus for good."""
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
        """Hand frames to the bus if they would not wait there; return the bytes that it took."""
        watch = self.watch
        if not watch.may_send(now):
            return 0
        taken = self._send(packet)
        if not watch.echoes:
            return taken
        if taken < len(packet):
            awaited = self._awaited(packet[:taken])
            # a question that found no room shows nothing: later ones do, and none comes back
            if not all(can_id & REMOTE_FLAG for can_id, _ in unpack_frames(packet[taken:])):
                watch.refused(now)
        for _ in range(awaited):
            watch.sent(now)
        return taken

    def _awaited(self, packet: bytes) -> int:
        """Return how many frames of a packet are awaited back."""
        return sum(can_id in self._own for can_id, _ in unpack_frames(packet))

    def _send_probe(self, now: int) -> None:
        """Send a frame that changes nothing: that it comes back shows that the bus carries."""
        if self._send(self._probe):
            self.watch.sent(now)

    def _look_after(self, now: int) -> None:
        """Ask what the bus has carried; restart, probe or greet it if that is due."""
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
        """Throw away what waits in the kernel and the adapter, of whatever process."""
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
        """Close the bus; what waited for it is not for the next one."""
        if self._bus is not None:
            with suppress(can.CanError, OSError):
                self._bus.shutdown()
        self._bus = None
        self._receive = _nothing
        self._send = _drop
        self._carried = None
        self._commands = b""


def filters(node_ids: Sequence[int]) -> list[dict[str, Any]]:
    """Return python-can's filters for what drives send, and for own frames that are awaited back.

    Error frames pass them.
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
    """Return how to receive from a bus: one wait, then all that is there.

    A bus of the kernel is read at its socket: python-can makes an object of each frame, and waits
    by the wall clock, so that one set back on a silent bus (NTP) would hold up the loop.
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
    """Return how to send several frames on a bus; one that it does not take ends the row."""
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
    """Return a packed frame as python-can has it."""
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
