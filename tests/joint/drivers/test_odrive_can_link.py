"""The CAN driver on a bus that fails, behind nothing but python-can's own interface."""

from __future__ import annotations

import errno
from collections.abc import Callable

import can
import pytest

from services.joint.drivers.base import DriveStatus
from services.joint.drivers.can_link import FRAMES_PER_READ, RETRY_MS, receiver
from services.joint.drivers.odrive_can import ARM_GRACE_MS
from shared.can.cansimple import AxisState, Command, arbitration_id, pack_two_floats
from shared.can.cansimple_06 import Command06
from shared.clock import NS_PER_MS
from tests.joint.drivers.can_bench import (
    TARGET,
    Bench,
    bench,
    error_frame,
    error_on_the_wire,
    frame,
)
from tests.joint.drivers.test_odrive_can import DRIVE, NODES

__all__ = ["bench"]  # fixtures

DOWN = OSError(errno.ENETDOWN, "Network is down")


def error_state(bench: Bench) -> None:
    bench.bus.shown = can.BusState.ERROR


def interface_down(bench: Bench) -> None:
    bench.bus.waiting.append(DOWN)
    bench.bus.room, bench.bus.when_full = 0, DOWN


def receiving_fails(bench: Bench) -> None:
    bench.bus.waiting.append(can.CanOperationError("Failed to receive: Network is down"))


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
    assert bench.driver.bus_offs == counted
    assert bench.after(0.5e3 * DRIVE.watchdog_timeout) is None
    reading = bench.after(1e3 * DRIVE.watchdog_timeout)
    assert reading is not None
    assert reading.status is DriveStatus.LOST
    bench.after(RETRY_MS)
    assert bench.driver.connections == 2
    reading = bench.receive(AxisState.CLOSED_LOOP_CONTROL)
    assert reading is not None
    assert reading.status is DriveStatus.ARMED, "the drive has held on all the while"


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
    assert bench.driver.bus_offs == counted * len([bus for bus in bench.buses if bus.closed])
    assert bench.driver.write_failures > 1000


@pytest.mark.parametrize("error", [DOWN, can.CanInitializationError("no such device")])
def test_a_bus_that_cannot_be_opened_is_tried_again(bench: Bench, error: Exception) -> None:
    interface_down(bench)
    bench.after(1)
    bench.refuses = error
    for _ in range(10):
        assert bench.driver.read(0.05) is not None
    assert bench.driver.connections == 1
    bench.refuses = None
    bench.after(RETRY_MS)
    assert bench.driver.connections == 2


def test_reading_without_a_bus_takes_the_time_that_it_was_given(bench: Bench) -> None:
    error_on_the_wire(bench)
    bench.after(1)
    before = bench.now_ns
    bench.driver.read(0.005)
    assert bench.now_ns - before == 5 * NS_PER_MS


def test_a_bus_that_is_back_at_once_is_gone_on_with_before_the_next_heartbeat(
    bench: Bench,
) -> None:
    bench.wait(1e-3 * RETRY_MS)
    bench.armed()
    receiving_fails(bench)
    assert bench.after(1) is None
    bench.after(1)
    assert bench.driver.connections == 2
    reading = bench.receive(None)
    assert reading is not None
    assert (reading.status, bench.driver.dialect) == (DriveStatus.ARMED, "0.5")


def test_a_heartbeat_from_before_an_order_is_not_believed_after_it(bench: Bench) -> None:
    bench.receive()
    bench.driver.arm(onboard=True)
    reading = bench.receive(AxisState.IDLE, error=0x40)
    assert reading is not None
    assert (reading.status, reading.error) == (DriveStatus.IDLE, 0)
    bench.wait(1e-3 * ARM_GRACE_MS)
    reading = bench.receive(AxisState.IDLE, error=0x40)
    assert reading is not None
    assert (reading.status, reading.error) == (DriveStatus.ERROR, 0x40)


@pytest.mark.parametrize("data", [b"", b"\x02", bytes(7)])
def test_a_request_for_a_version_by_somebody_else_is_no_version(bench: Bench, data: bytes) -> None:
    bench.bus.waiting.append(frame(NODES[0], Command06.GET_VERSION, data))
    bench.after(1)
    assert bench.driver.dialect == ""


def test_trouble_on_the_wire_that_leaves_the_controller_on_it_is_counted_only(bench: Bench) -> None:
    bench.armed()
    passive = error_frame(0x04, bytes((0, 0x20, 0, 0, 0, 0, 0, 0)))
    bench.bus.waiting.extend([passive, passive])
    reading = bench.receive(AxisState.CLOSED_LOOP_CONTROL)
    assert reading is not None
    assert reading.status is DriveStatus.ARMED
    assert bench.driver._link.error_frames == 2
    assert (bench.driver.bus_offs, bench.driver.connections) == (0, 1)


def test_an_error_frame_is_not_taken_for_a_frame_of_a_node(bench: Bench) -> None:
    """Class 0x80 (an error on the bus) has the number of node 4's version."""
    bench.receive()
    bench.bus.waiting.append(error_frame(arbitration_id(NODES[0], 0)))
    bench.after(1)
    assert bench.driver.dialect == "0.5"


def test_extended_and_remote_frames_of_the_same_number_are_not_ours(bench: Bench) -> None:
    bench.receive()
    estimate = pack_two_floats(99.0, 0.0)
    for node in NODES:
        bench.bus.waiting.append(
            frame(node, Command.GET_ENCODER_ESTIMATES, estimate, is_extended_id=True)
        )
        bench.bus.waiting.append(frame(node, Command.GET_ENCODER_ESTIMATES, is_remote_frame=True))
    assert bench.after(1) is None


def test_a_flooded_bus_does_not_hold_up_the_loop(bench: Bench) -> None:
    """What is there is taken without waiting for more, and not all of it at once."""
    timeouts = []

    def flood(timeout: float | None) -> tuple[can.Message | None, bool]:
        timeouts.append(timeout)
        return frame(NODES[0], Command.GET_IQ, is_remote_frame=True), True

    bench.bus._recv_internal = flood  # type: ignore[method-assign]
    assert list(receiver(bench.bus, in_kernel=False)(0.5)) == []
    assert timeouts == [0.5] + [0.0] * (FRAMES_PER_READ - 1)
