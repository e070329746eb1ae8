"""What the CAN driver does about a drive that does not do, or no longer says, what it should."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

import can
import pytest

from services.joint.drivers.base import DriveStatus
from services.joint.drivers.can_link import receiver
from services.joint.drivers.odrive_can import ARM_GRACE_MS, INSIST_MS, REBOOT_MS
from shared.can.cansimple import AxisState, Command, Heartbeat, pack_heartbeat, pack_two_floats
from tests.joint.drivers.can_bench import Bench, FakeBus, bench, frame
from tests.joint.drivers.test_odrive_can import NODES

__all__ = ["bench"]  # fixtures

CLOSED, IDLE = AxisState.CLOSED_LOOP_CONTROL, AxisState.IDLE
SOMEWHERE = pack_two_floats(0.25, 0.0)
"""An estimate that says something: 0, 0 is asked about (`odrive_answers`)."""
IDLING = [Command.SET_INPUT_TORQUE] * 2 + [Command.SET_AXIS_STATE] * 2


def say(bench: Bench, node: int, state: AxisState) -> None:
    """Have a node send a heartbeat, and both an estimate, 20 ms later."""
    said = Heartbeat(0, state, False, False, False, trajectory_done=True)
    bench.bus.waiting.append(frame(node, Command.HEARTBEAT, pack_heartbeat(said)))
    for each in NODES:
        bench.bus.waiting.append(frame(each, Command.GET_ENCODER_ESTIMATES, SOMEWHERE))
    bench.after(2 * ARM_GRACE_MS)


# ---- an order to go idle that was lost


def test_an_axis_that_goes_on_after_idle_is_told_again_at_its_next_heartbeat(bench: Bench) -> None:
    """Its sibling may have disarmed: two motors of a differential, and one of them pulls."""
    bench.armed()
    bench.driver.idle()
    assert bench.commands() == IDLING
    say(bench, NODES[0], IDLE)
    assert bench.commands() == []
    for _ in range(3):
        say(bench, NODES[1], CLOSED)
        assert bench.commands() == IDLING
    say(bench, NODES[1], IDLE)
    assert bench.commands() == []


def test_a_heartbeat_from_before_idle_brings_no_second_order(bench: Bench) -> None:
    bench.armed()
    bench.driver.idle()
    bench.commands()
    bench.receive(CLOSED)
    assert bench.commands() == []


@pytest.mark.parametrize("armed_again", [True, False])
def test_nobody_is_idled_whom_somebody_armed_since(bench: Bench, armed_again: bool) -> None:
    bench.armed()
    bench.driver.idle()
    if armed_again:
        bench.driver.arm(onboard=True)
    else:  # by somebody else, later
        bench.wait(1e-3 * INSIST_MS)
    bench.commands()
    say(bench, NODES[0], CLOSED)
    assert Command.SET_AXIS_STATE not in bench.commands()


# ---- heartbeats that end


def test_estimates_without_heartbeats_are_a_lost_drive_for_nobody_would_see_it_disarm(
    bench: Bench,
) -> None:
    bench.armed()
    statuses = []
    for _ in range(REBOOT_MS + 20):
        reading = bench.receive(None)
        assert reading is not None
        statuses.append(reading.status)
    assert statuses[: REBOOT_MS - 20] == [DriveStatus.ARMED] * (REBOOT_MS - 20)
    assert statuses[-10:] == [DriveStatus.LOST] * 10
    bench.receive(CLOSED)
    reading = bench.receive(CLOSED)
    assert reading is not None
    assert reading.status is DriveStatus.ARMED


@pytest.mark.parametrize("mute", NODES)
def test_the_heartbeats_of_one_axis_do_not_speak_for_the_other(bench: Bench, mute: int) -> None:
    bench.armed()
    speaks = NODES[1 - NODES.index(mute)]
    for _ in range(2 * REBOOT_MS // (2 * ARM_GRACE_MS)):
        say(bench, speaks, CLOSED)
    reading = bench.receive(None)
    assert reading is not None
    assert reading.status is DriveStatus.LOST


# ---- a current that is no number


def test_a_drive_is_not_taken_over_by_a_current_that_is_no_number(bench: Bench) -> None:
    bench.receive(CLOSED)
    for node, current in zip(NODES, (float("nan"), 1.0), strict=True):
        bench.bus.waiting.append(frame(node, Command.GET_IQ, pack_two_floats(current, 0.0)))
    reading = bench.receive(None)
    assert reading is not None
    assert reading.torque is None
    bench.bus.waiting.append(frame(NODES[0], Command.GET_IQ, pack_two_floats(2.0, 0.0)))
    reading = bench.receive(None)
    assert reading is not None
    assert reading.torque is not None


# ---- a wall clock that is set back


class QuietBus(FakeBus):
    """A bus on a file descriptor, as socketcan's, with nothing on it."""

    def __init__(self) -> None:
        self.ends = os.pipe()
        super().__init__("can7")

    def fileno(self) -> int:
        return self.ends[0]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        assert timeout is not None
        assert timeout < 1.0, "the wait is by the wall clock"
        os.read(self.ends[0], 1)
        return super()._recv_internal(timeout)


@pytest.fixture
def quiet() -> Iterator[QuietBus]:
    bus = QuietBus()
    yield bus
    for end in bus.ends:
        os.close(end)
    with pytest.raises(OSError, match="closed twice"):
        bus.shutdown()


def test_a_wall_clock_set_back_does_not_hold_up_reading_a_silent_bus(
    quiet: QuietBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    backwards = iter(range(10**9, 0, -3600))
    monkeypatch.setattr("can.bus.time", lambda: next(backwards))
    receive = receiver(quiet, in_kernel=True)
    before = time.monotonic()
    assert list(receive(0.01)) == []
    assert time.monotonic() - before > 0.009
    assert next(backwards) == 10**9, "python-can was not asked"


def test_a_frame_on_a_bus_in_the_kernel_is_read_at_once(quiet: QuietBus) -> None:
    quiet.waiting.append(frame(NODES[0], Command.HEARTBEAT, bytes(8)))
    os.write(quiet.ends[1], b"12")
    assert len(receiver(quiet, in_kernel=True)(5.0)) == 1
