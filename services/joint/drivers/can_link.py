"""A CAN link by python-can as the drivers use it: it never blocks, never raises, comes back."""

from __future__ import annotations

import select
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, TypeAlias

import can

from services.joint.drivers.bus_watch import BusWatch
from shared.can import cansimple
from shared.can.cansimple import Command
from shared.can.cansimple_06 import Command06
from shared.can.interface import limit_queue, restart
from shared.can.unix_can import ERROR_FLAG, EXTENDED_FLAG
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

Frame: TypeAlias = tuple[int, bytes]
"""Arbitration id, with SocketCAN's flags, and payload."""
Receive: TypeAlias = Callable[[float], Sequence[Frame]]
"""Waits for at most the given seconds and returns all received frames."""
Send: TypeAlias = Callable[[Sequence[can.Message]], int]
"""Returns how many of the messages, from the first, the bus has taken."""


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
        self._probe = (message(node_ids[0], Command06.GET_VERSION, b""),)
        self._greeting: Sequence[can.Message] = ()
        self._bus: can.BusABC | None = None
        self._receive: Receive = _nothing
        self._send: Send = _drop
        self._retry_at_ns = 0
        self._commands: Sequence[can.Message] = ()
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
        self._receive = receiver(self._bus, in_kernel=self._config.interface in IN_KERNEL)
        self._send = sender(self._bus)
        return True

    def receive(self, timeout_s: float) -> Sequence[Frame]:
        """Return the frames of one wait; none, too, if the bus failed, which closes it.

        Error frames are among them: they are for `error_frame`.
        """
        if self._commands:
            self._send_commands()
        try:
            frames = self._receive(timeout_s)
            off = not frames and self._bus is not None and self._bus.state is can.BusState.ERROR
        except (can.CanError, OSError):
            self._disconnect()
            return ()
        if off:
            self._go_off()
        else:
            self._look_after(frames)
        return frames

    def error_frame(self, can_id: int) -> None:
        """Take in an error frame: a bus that is off is closed."""
        if can_id & BUS_OFF:
            self._go_off()
        else:
            self.error_frames += 1

    def send(self, messages: Sequence[can.Message]) -> bool:
        """Hand messages to the bus; False if it did not take them all.

        What waits by `order` goes first; until it has gone, nothing else goes.
        """
        if self._commands and not self._send_commands():
            return False
        # A full queue comes here too. A dead link shows in receiving.
        return self._hand_over(messages, now_ns()) == len(messages)

    def greet(self, messages: Sequence[can.Message]) -> None:
        """Send the first requests on a newly opened bus.

        They go before the drive was heard: whether they are carried shows if anybody is there, and
        whether frames wait from an earlier process. After an outage they wait for the drive.
        """
        if self.watch.unacknowledged:
            self._greeting = messages
        else:
            self._send(messages)
            self._send_probe(now_ns())

    def order(self, messages: Sequence[can.Message], *, proven: bool = False) -> None:
        """Send messages of which none may be missing, in this order.

        A row of a dozen can be longer than the queue of the interface (ten frames, unless
        set): the rest follows when there is room, within `COMMANDS_MS`. They take the place
        of an order that is still waiting.

        Args:
            messages: the row.
            proven: send it only once the bus has just carried a frame: an arming request that had
                to wait would arm a drive at another time.
        """
        if self._bus is None:
            return
        self._commands = [*messages, *self._probe] if proven and self.watch.echoes else messages
        self._commands_until_ns = now_ns() + COMMANDS_MS * NS_PER_MS
        self._commands_proven = proven
        self._send_commands()

    def close(self) -> None:
        """Leave the bus for good."""
        self._disconnect()
        self._retry_at_ns = 1 << 63

    def _send_commands(self) -> bool:
        """Send as many frames as the bus has room for; True if none is left."""
        now = now_ns()
        if now > self._commands_until_ns:
            self._commands = ()
        elif not self._commands_proven or self.watch.may_arm(now):
            self._commands = self._commands[self._hand_over(self._commands, now) :]
        elif self.watch.may_send(now) and not self.watch.waits:
            self._send_probe(now)
        return not self._commands

    def _hand_over(self, messages: Sequence[can.Message], now: int) -> int:
        """Hand frames to the bus if they would not wait there; return how many it took."""
        watch = self.watch
        if not watch.may_send(now):
            return 0
        taken = self._send(messages)
        if watch.echoes:
            for each in messages[:taken]:
                if each.arbitration_id in self._own and not each.is_remote_frame:
                    watch.sent(now)
            # a question that found no room shows nothing: later ones do, and none comes back
            if not all(each.is_remote_frame for each in messages[taken:]):
                watch.refused(now)
        return taken

    def _send_probe(self, now: int) -> None:
        """Send a frame that changes nothing: that it comes back shows that the bus carries."""
        if self._send(self._probe):
            self.watch.sent(now)

    def _look_after(self, frames: Sequence[Frame]) -> None:
        """Take in what frames show of the bus; throw away what must not wait any longer."""
        watch, now = self.watch, now_ns()
        for can_id, _ in frames:
            if can_id in self._drives:
                watch.heard(now)
            elif can_id in self._own:
                watch.carried(now)
        if watch.restart_due(now):
            self._restart()
        elif watch.probe_due(now):
            self._send_probe(now)
        elif self._greeting and watch.may_send(now):
            self._greeting, greeting = (), self._greeting
            self._send(greeting)

    def _restart(self) -> None:
        """Throw away what waits in the kernel and the adapter, of whatever process."""
        self._commands = ()
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
        self._commands = ()


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
    """Return the bus's `recv_many`, or one made for it: one wait, then all that is there.

    Where it can be, the wait is not python-can's: that is by the wall clock, and one set back
    in the middle of it on a silent bus (NTP) would hold up the loop by as much.
    """
    ready: Receive | None = getattr(bus, "recv_many", None)
    if ready is not None:
        return ready
    waits_for = (bus,) if in_kernel else ()

    def receive(timeout_s: float) -> Sequence[Frame]:
        if waits_for:
            if not select.select(waits_for, (), (), timeout_s)[0]:
                return ()
            timeout_s = 0.0
        frames: list[Frame] = []
        for _ in range(FRAMES_PER_READ):
            message = bus.recv(timeout_s)
            if message is None:
                break
            timeout_s = 0.0
            if message.is_error_frame:
                frames.append((message.arbitration_id | ERROR_FLAG, bytes(message.data)))
            elif not message.is_remote_frame:
                flag = EXTENDED_FLAG if message.is_extended_id else 0
                frames.append((message.arbitration_id | flag, bytes(message.data)))
        return frames

    return receive


def sender(bus: can.BusABC) -> Send:
    """Return how to send several messages on a bus; one that it does not take ends the row."""
    many: Callable[[Sequence[can.Message]], None] | None = getattr(bus, "send_many", None)
    if many is not None:

        def send_many(messages: Sequence[can.Message]) -> int:
            try:
                many(messages)
            except (can.CanError, OSError):
                return 0
            return len(messages)

        return send_many

    def send(messages: Sequence[can.Message]) -> int:
        for count, message in enumerate(messages):
            try:
                bus.send(message, timeout=0.0)
            except (can.CanError, OSError):
                return count
        return len(messages)

    return send


def _nothing(_timeout_s: float) -> Sequence[Frame]:
    """Receive without a bus."""
    return ()


def _drop(_messages: Sequence[can.Message]) -> int:
    """Send without a bus."""
    return 0
