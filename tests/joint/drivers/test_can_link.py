"""The link to a CAN bus that fails, is full, or is flooded; and what the kernel filters."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator

import can
import pytest

from services.joint.drivers.can_link import (
    ECHOED,
    FRAMES_PER_READ,
    HEARD,
    RETRY_MS,
    packed,
    receiver,
    sender,
)
from services.joint.drivers.odrive_can import OdriveCan
from shared.bus.messages import DriveStatus
from shared.can.cansimple import AxisState, Command, arbitration_id, pack_two_floats
from shared.can.cansimple_06 import Command06
from shared.can.interface import limit_queue
from shared.can.unix_can import FRAME_BYTES
from shared.clock import NS_PER_MS
from shared.config.sections import CanConfig
from shared.exceptions import DriveError
from tests.joint.drivers.can_bench import (
    DOWN,
    Bench,
    FakeBus,
    error_frame,
    error_on_the_wire,
    error_state,
    frame,
    interface_down,
    receiving_fails,
)
from tests.joint.drivers.rig import DRIVE, MS, NODES, TARGET, Rig, Shed, arm, read

TROUBLES = pytest.mark.parametrize(
    ("trouble", "counted"),
    [(error_on_the_wire, 1), (error_state, 1), (interface_down, 0), (receiving_fails, 0)],
)


@TROUBLES
def test_a_bus_that_fails_is_silence_then_a_lost_drive_and_is_opened_again(
    bench: Bench, trouble: Callable[[Bench], None], counted: int
) -> None:
    bench.armed()
    failed = bench.bus
    trouble(bench)
    assert bench.after(1) is None, "silence, not yet lost"
    assert failed.closed == 1
    assert bench.driver._link.bus_offs == counted
    assert bench.after(0.5e3 * DRIVE.watchdog_timeout) is None
    assert bench.seen(1e3 * DRIVE.watchdog_timeout).status is DriveStatus.LOST
    bench.after(RETRY_MS)
    assert len(bench.buses) == 2
    assert bench.receive(AxisState.CLOSED_LOOP_CONTROL).status is DriveStatus.ARMED, (
        "the drive has held on all the while"
    )


@TROUBLES
def test_a_bus_that_fails_at_each_attempt_is_tried_now_and_then_and_nothing_raises(
    bench: Bench, trouble: Callable[[Bench], None], counted: int
) -> None:
    bench.armed()
    for _ in range(1000):
        if bench.driver._link.is_open:
            trouble(bench)
        bench.driver.write(TARGET)
        bench.driver.write_torque((1.0, 1.0))
        bench.after(2)
    assert 5 <= len(bench.buses) <= 2000 / RETRY_MS + 2
    assert bench.driver._link.bus_offs == counted * len([bus for bus in bench.buses if bus.closed])
    assert bench.driver.write_failures > 1000


@pytest.mark.parametrize("error", [DOWN, can.CanInitializationError("no such device")])
def test_a_bus_that_cannot_be_opened_is_tried_again(bench: Bench, error: Exception) -> None:
    """Reading without a bus takes the time that it was given."""
    interface_down(bench)
    bench.after(1)
    bench.refuses, before = error, bench.now_ns
    for _ in range(10):
        assert bench.driver.read(0.05) is not None
    assert bench.now_ns - before == 500 * NS_PER_MS
    assert len(bench.buses) == 1
    bench.refuses = None
    bench.after(RETRY_MS)
    assert len(bench.buses) == 2


def test_a_bus_that_is_back_at_once_is_gone_on_with_before_the_next_heartbeat(bench: Bench) -> None:
    bench.wait(1e-3 * RETRY_MS)
    bench.armed()
    receiving_fails(bench)
    assert bench.after(1) is None
    bench.after(1)
    assert len(bench.buses) == 2
    reading = bench.receive(None)
    assert (reading.status, bench.driver.dialect) == (DriveStatus.ARMED, "0.5")


def test_trouble_on_the_wire_that_leaves_the_controller_on_it_is_counted_only(bench: Bench) -> None:
    bench.armed()
    passive = error_frame(0x04, bytes((0, 0x20, 0, 0, 0, 0, 0, 0)))
    bench.bus.waiting.extend([passive, passive])
    assert bench.receive(AxisState.CLOSED_LOOP_CONTROL).status is DriveStatus.ARMED
    assert bench.driver._link.error_frames == 2
    assert (bench.driver._link.bus_offs, len(bench.buses)) == (0, 1)


def test_frames_that_only_have_the_number_of_a_nodes_are_not_taken_for_it(bench: Bench) -> None:
    """An error frame of class 0x80 has that of node 4's version; others are extended or remote.

    A foreign request for a version is none.
    """
    for data in (b"", b"\x02", bytes(7)):
        bench.bus.waiting.append(frame(NODES[0], Command06.GET_VERSION, data))
        bench.after(1)
        assert bench.driver.dialect == ""
    bench.receive()
    bench.bus.waiting.append(error_frame(arbitration_id(NODES[0], 0)))
    for node in NODES:
        for odd in ("is_extended_id", "is_remote_frame"):
            data = pack_two_floats(99.0, 0.0) if odd == "is_extended_id" else b""
            bench.send(node, Command.GET_ENCODER_ESTIMATES, data, **{odd: True})
    assert bench.after(1) is None
    assert bench.driver.dialect == "0.5"


def test_a_flooded_bus_does_not_hold_up_the_loop(bench: Bench) -> None:
    """What is there is taken without waiting for more, and not all of it at once."""
    timeouts = []

    def flood(timeout: float | None) -> tuple[can.Message | None, bool]:
        timeouts.append(timeout)
        return frame(NODES[0], Command.GET_IQ, is_remote_frame=True), True

    bench.bus._recv_internal = flood  # type: ignore[method-assign]
    assert receiver(bench.bus, in_kernel=False)(0.5) == b""
    assert timeouts == [0.5] + [0.0] * (FRAMES_PER_READ - 1)


def test_driver_starts_without_a_bus_and_finds_it_later(shed: Shed) -> None:
    driver = shed.driver()
    assert read(driver, 0.001).status is DriveStatus.LOST
    driver.write_torque((1.0, 1.0))
    driver.arm(onboard=False)
    driver.idle()
    assert driver.write_failures == 1
    rig = shed.rig()
    time.sleep(RETRY_MS * MS)
    driver.read(0.0)
    assert rig.cycle(driver).status == DriveStatus.IDLE
    arm(rig, driver)


def test_driver_is_lost_with_its_hub_and_arms_again_with_a_new_one(shed: Shed) -> None:
    old = shed.rig()
    driver = shed.connected(old)
    arm(old, driver)
    time.sleep(RETRY_MS * MS)
    old.hub.close()
    assert read(driver, 0.01).status is DriveStatus.LOST
    driver.write_torque((1.0, 1.0))
    new = shed.rig()
    time.sleep(RETRY_MS * MS)
    driver.read(0.0)
    # The new drive is in IDLE without having been asked: that is no state to go on from.
    assert new.cycle(driver).status == DriveStatus.ERROR
    arm(new, driver)
    driver.write_torque((0.5, 0.25))
    assert list(new.step()[[4, 5]]) == [0.5, 0.25]


def test_writing_to_a_deaf_hub_never_blocks_or_raises(rig: Rig, driver: OdriveCan) -> None:
    for _ in range(5000):
        driver.write_torque((1.0, 2.0))
    rig.front.receive()
    assert list(rig.bank.input_torque[[4, 5]]) == [1.0, 2.0]


def test_driver_runs_on_a_bus_with_nothing_but_the_api_of_python_can() -> None:
    """One that python-can does not know is refused at the start."""
    with pytest.raises(DriveError, match="no_such_bus"):
        OdriveCan(CanConfig(interface="no_such_bus", channel="x"), NODES, DRIVE)
    driver = OdriveCan(CanConfig(interface="virtual", channel="test_odrive_can"), NODES, DRIVE)
    with can.Bus(interface="virtual", channel="test_odrive_can", ignore_config=True) as drive_side:
        for node, pos in zip(NODES, (1.0, 2.0), strict=True):
            drive_side.send(frame(node, Command.HEARTBEAT, bytes((0, 0, 0, 0, 1, 0, 0, 0x80))))
            estimate = pack_two_floats(pos, -pos)
            drive_side.send(frame(node, Command.GET_ENCODER_ESTIMATES, estimate))
        reading = read(driver)
        driver.write_torque((0.5, -0.5))
        sent = [drive_side.recv(0.5) for _ in range(4)]
    driver.close()
    assert (reading.status, reading.pos_turns) == (DriveStatus.IDLE, (1.0, 2.0))
    orders = [each for each in sent if each is not None and each.data]  # and two requests
    assert [(message.arbitration_id, bytes(message.data)) for message in orders] == [
        (0x08E, bytes.fromhex("0000003f")),
        (0x0AE, bytes.fromhex("000000bf")),
    ]


def test_the_kernel_filters_by_the_nodes_to_wake_for(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In software a filter saves nothing, and would keep error frames away."""
    assert "can_filters" not in bench.bus.options
    kernel = Bench(monkeypatch, "socketcan")
    found = kernel.bus.options["can_filters"]
    assert isinstance(found, list)
    passing = {
        can_id
        for can_id in range(1 << 11)
        for each in found
        if can_id & each["can_mask"] == each["can_id"] & each["can_mask"]
    }
    theirs = (*HEARD, Command06.GET_VERSION)
    assert passing == {arbitration_id(node, command) for node in NODES for command in theirs} | {
        arbitration_id(NODES[0], command) for command in ECHOED
    }
    assert {*kernel.driver._takers} <= passing, "what the driver takes must wake it"
    assert kernel.bus.options["receive_own_messages"] is True
    assert all(each["extended"] is False for each in found)
    kernel.driver.close()


class KernelBus(FakeBus):
    """A bus at a socket, as socketcan's; `wire` is its other end."""

    def __init__(self) -> None:
        self.socket, self.wire = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        super().__init__("can7")

    def close(self) -> None:
        for end in (self.socket, self.wire):
            end.close()
        with pytest.raises(OSError, match="closed twice"):
            self.shutdown()


@pytest.fixture
def kernel() -> Iterator[KernelBus]:
    bus = KernelBus()
    yield bus
    bus.close()


def test_a_bus_of_the_kernel_is_read_at_its_socket_and_silence_ends_by_the_monotonic_clock(
    kernel: KernelBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wall clock set back does not hold up the loop."""
    backwards = iter(range(10**9, 0, -3600))
    monkeypatch.setattr("can.bus.time", lambda: next(backwards))
    receive = receiver(kernel, in_kernel=True)
    before = time.monotonic()
    assert receive(0.01) == b""
    assert time.monotonic() - before > 0.009
    frames = [packed(node, Command.HEARTBEAT, bytes(8)) for node in NODES]
    for each in frames:
        kernel.wire.send(each)
    assert receive(5.0) == b"".join(frames)
    assert next(backwards) == 10**9, "python-can was not asked"


def test_a_bus_of_the_kernel_takes_what_there_is_room_for(kernel: KernelBus) -> None:
    """Frames that may wait are few (`limit_queue`); the rest of the row is not sent."""
    limit_queue(kernel)
    send = sender(kernel, in_kernel=True)
    frames = [packed(NODES[0], Command.SET_POS_GAIN, bytes((n, 0, 0, 0))) for n in range(100)]
    taken = send(b"".join(frames))
    assert 0 < taken < 100 * FRAME_BYTES
    kernel.wire.setblocking(False)
    arrived = b"".join(kernel.wire.recv(FRAME_BYTES) for _ in range(taken // FRAME_BYTES))
    assert arrived == b"".join(frames)[:taken]
    with pytest.raises(BlockingIOError):
        kernel.wire.recv(FRAME_BYTES)
