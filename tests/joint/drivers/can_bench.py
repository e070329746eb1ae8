"""A CAN driver on buses whose every answer the test writes, in the test's own time."""

from __future__ import annotations

import copy
import errno
import time
from collections import deque

import can
import pytest

from services.joint.drivers import can_link, odrive_can
from services.joint.drivers.base import DriveReading
from services.joint.drivers.can_link import BUS_OFF
from services.joint.drivers.frame_times import ARM_GRACE_MS
from services.joint.drivers.odrive_can import OdriveCan
from shared.bus.messages import DriveStatus
from shared.can.cansimple import (
    AxisState,
    Command,
    Heartbeat,
    arbitration_id,
    pack_heartbeat,
    pack_two_floats,
    split_id,
)
from shared.config.sections import CanConfig
from tests.joint.drivers.rig import DRIVE, NODES

COUNTS_PER_TURN = 1000
FULL = can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS)
DOWN = OSError(errno.ENETDOWN, "Network is down")


class FakeBus(can.BusABC):
    """A bus whose answers the test writes: messages, and exceptions to raise."""

    def __init__(self, channel: str, **kwargs: object) -> None:
        self.waiting: deque[can.Message | Exception] = deque()
        self.sent: list[can.Message] = []
        self.room = 1 << 30
        """How many messages the queue still takes."""
        self.when_full: Exception = FULL
        self.shown = can.BusState.ACTIVE
        self.closed = 0
        self.options = kwargs
        super().__init__(channel)

    @property  # type: ignore[misc]
    def state(self) -> can.BusState:
        return self.shown

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        assert timeout == 0.0, "the loop must not wait"
        if self.room == 0:
            raise self.when_full
        self.room -= 1
        self.sent.append(copy.deepcopy(msg))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:  # noqa: ARG002
        each = self.waiting.popleft() if self.waiting else None
        if isinstance(each, Exception):
            raise each
        return each, True

    def shutdown(self) -> None:
        self.closed += 1
        super().shutdown()
        raise OSError(errno.EBADF, "closed twice")  # a broken adapter


class Bench:
    """A driver on fake buses, in the test's own time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, interface: str = "fake") -> None:
        self.now_ns = 1
        self.buses: list[FakeBus] = []
        self.refuses: Exception | None = None
        self.talks = True
        """The drive is heard while the test waits."""
        for module in (odrive_can, can_link):
            monkeypatch.setattr(module, "now_ns", lambda: self.now_ns)
        monkeypatch.setattr(time, "sleep", self.wait)
        monkeypatch.setattr(can, "Bus", self.open)
        self.driver = OdriveCan(
            CanConfig(interface=interface, channel="can7"),
            NODES,
            DRIVE,
            encoder_counts_per_turn=COUNTS_PER_TURN,
        )

    @property
    def bus(self) -> FakeBus:
        return self.buses[-1]

    def open(self, channel: str, interface: str, ignore_config: bool, **kwargs: object) -> FakeBus:
        assert ignore_config
        assert interface
        if self.refuses is not None:
            raise self.refuses
        self.buses.append(FakeBus(channel, **kwargs))
        return self.bus

    def wait(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)
        if self.talks and self.buses:
            self.driver._link.watch.received(self.now_ns)

    def after(self, ms: float) -> DriveReading | None:
        """Read so much later what there is."""
        self.wait(ms * 1e-3)
        return self.driver.read(0.0)

    def seen(self, ms: float) -> DriveReading:
        """Read so much later what is there for sure."""
        reading = self.after(ms)
        assert reading is not None
        return reading

    def send(self, node: int, command: int, data: bytes = b"", **kwargs: bool) -> None:
        """Have a node send a frame."""
        self.bus.waiting.append(frame(node, command, data, **kwargs))

    def beat(self, node: int, state: int, error: int = 0) -> None:
        """Have a node send a heartbeat."""
        heartbeat = Heartbeat(error, state, False, False, False, trajectory_done=True)
        self.send(node, Command.HEARTBEAT, pack_heartbeat(heartbeat))

    def receive(self, state: int | None = AxisState.IDLE, error: int = 0) -> DriveReading:
        """Have both axes send an estimate, and a heartbeat if there is a state, and read them."""
        for node in NODES:
            if state is not None:
                self.beat(node, state, error)
            self.send(node, Command.GET_ENCODER_ESTIMATES, pack_two_floats(node, 0.0))
        return self.seen(1)

    def armed(self, *, onboard: bool = True) -> None:
        self.receive()
        self.driver.arm(onboard=onboard)
        self.wait(2e-3 * ARM_GRACE_MS)
        assert self.receive(AxisState.CLOSED_LOOP_CONTROL).status is DriveStatus.ARMED
        self.bus.sent.clear()

    def sent(self) -> list[tuple[int, int]]:
        """Return node and command of each frame that the bus has taken since the last look."""
        ids = [split_id(message.arbitration_id) for message in self.bus.sent]
        self.bus.sent.clear()
        return ids

    def commands(self) -> list[int]:
        """Return the commands that the bus has taken since the last look."""
        return [command for _, command in self.sent()]


def frame(node: int, command: int, data: bytes = b"", **kwargs: bool) -> can.Message:
    kwargs.setdefault("is_extended_id", False)
    return can.Message(arbitration_id=arbitration_id(node, command), data=data, **kwargs)


def error_frame(error_class: int, data: bytes = bytes(8)) -> can.Message:
    flags = {"is_error_frame": True, "is_extended_id": False}
    return can.Message(arbitration_id=error_class, data=data, **flags)


def error_on_the_wire(bench: Bench) -> None:
    bench.bus.waiting.append(error_frame(BUS_OFF))


def error_state(bench: Bench) -> None:
    bench.bus.shown = can.BusState.ERROR


def interface_down(bench: Bench) -> None:
    bench.bus.waiting.append(DOWN)
    bench.bus.room, bench.bus.when_full = 0, DOWN


def receiving_fails(bench: Bench) -> None:
    bench.bus.waiting.append(can.CanOperationError("Failed to receive: Network is down"))
