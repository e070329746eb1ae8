"""What the CAN driver sends, and what becomes of it when the queue is full."""

from __future__ import annotations

import itertools
import time

import can
import pytest

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.can_link import ORDERS_MS, RETRY_MS
from services.joint.drivers.resend_policy import GAINS_MS, SETTLE_MS
from shared.can.cansimple import AxisState, Command, arbitration_id, split_id
from tests.joint.drivers.can_bench import TARGET, Bench, bench
from tests.joint.drivers.test_odrive_can import NODES

__all__ = ["bench"]  # fixtures

# ---- a full queue


def test_arming_goes_on_as_the_queue_empties_and_closed_loop_is_asked_for_last(
    bench: Bench,
) -> None:
    bench.receive()
    bench.commands()
    bench.bus.room = 1 << 30
    bench.driver.arm(onboard=True)
    whole = bench.commands()
    bench.bus.room = 5
    bench.driver.arm(onboard=True)
    bits = [bench.commands()]
    for _ in range(3):
        bench.bus.room = 4
        bench.after(2)
        bits.append(bench.commands())
    assert [len(each) for each in bits] == [5, 4, 4, len(whole) - 13]
    assert list(itertools.chain(*bits)) == whole
    assert whole[-2:] == [Command.SET_AXIS_STATE] * 2


def test_nothing_overtakes_an_order_that_waits(bench: Bench) -> None:
    bench.armed()
    bench.bus.room = 1
    bench.driver.idle()
    bench.driver.write_torque((1.0, 1.0))
    bench.driver.write(TARGET)
    assert bench.commands() == [Command.SET_INPUT_TORQUE]
    assert bench.driver.write_failures == 2
    bench.bus.room = 100
    bench.driver.write_torque((1.0, 1.0))
    assert bench.commands() == [
        Command.SET_INPUT_TORQUE, *[Command.SET_AXIS_STATE] * 2, *[Command.SET_INPUT_TORQUE] * 2,
    ]  # fmt: skip


def test_an_order_takes_the_place_of_one_that_waits(bench: Bench) -> None:
    bench.receive()
    bench.commands()
    bench.bus.room = 0
    bench.driver.arm(onboard=True)
    bench.driver.idle()
    bench.bus.room = 100
    bench.after(1)
    assert bench.commands() == [*[Command.SET_INPUT_TORQUE] * 2, *[Command.SET_AXIS_STATE] * 2]


def test_an_order_that_waited_too_long_is_given_up(bench: Bench) -> None:
    """A drive must not arm long after it was asked to."""
    bench.receive()
    bench.commands()
    bench.bus.room = 0
    bench.driver.arm(onboard=True)
    bench.wait(1e-3 * ORDERS_MS + 1e-3)
    bench.bus.room = 100
    bench.after(1)
    assert bench.commands() == []


def test_an_order_does_not_go_to_the_next_bus(bench: Bench) -> None:
    bench.wait(1e-3 * RETRY_MS)
    bench.receive()
    bench.bus.room = 0
    bench.driver.arm(onboard=True)
    bench.bus.waiting.append(can.CanOperationError("Failed to receive"))
    bench.after(1)
    bench.after(1)
    assert bench.driver.connections == 2, "at once: it had been open for long"
    assert Command.SET_AXIS_STATE not in bench.commands()


def test_closing_waits_a_little_for_the_order_to_go_idle(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.armed()
    bench.bus.room = 0
    bench.driver.idle()

    def drain(seconds: float) -> None:
        bench.wait(seconds)
        bench.bus.room = 2

    monkeypatch.setattr(time, "sleep", drain)
    bench.driver.close()
    assert bench.commands()[-2:] == [Command.SET_AXIS_STATE] * 2


def test_gains_that_the_queue_had_no_room_for_are_sent_again(bench: Bench) -> None:
    bench.armed()
    bench.bus.room = 3
    bench.driver.write(TARGET)
    assert bench.driver.write_failures == 1
    bench.commands()
    bench.bus.room = 100
    bench.driver.write(TARGET)
    assert bench.commands().count(Command.SET_POS_GAIN) == 2


# ---- what is sent


def test_limits_and_modes_are_told_again_for_a_while_after_arming_and_then_no_more(
    bench: Bench,
) -> None:
    bench.armed()
    told = []
    for _ in range(0, 3 * SETTLE_MS, 10):
        bench.wait(0.01)
        bench.driver.write(TARGET)
        sent = bench.commands()
        told.append(sent.count(Command.SET_CONTROLLER_MODE))
        assert sent.count(Command.SET_LIMITS) == told[-1]
    assert sum(told) == pytest.approx(2 * SETTLE_MS / GAINS_MS, abs=2)
    assert not any(told[-100:])


def test_a_drive_that_was_found_armed_is_told_its_limits_and_modes(bench: Bench) -> None:
    bench.receive(AxisState.CLOSED_LOOP_CONTROL)
    bench.commands()
    bench.driver.write(TARGET)
    sent = bench.commands()
    assert sent.count(Command.SET_CONTROLLER_MODE) == sent.count(Command.SET_LIMITS) == 2
    bench.wait(2e-3 * GAINS_MS)
    bench.driver.write(TARGET)
    assert bench.commands().count(Command.SET_CONTROLLER_MODE) == 2, "the first may have been lost"


def test_modes_are_told_again_with_torques_too(bench: Bench) -> None:
    bench.armed(onboard=False)
    bench.driver.write_torque((0.0, 0.0))
    modes = [m for m in bench.bus.sent if split_id(m.arbitration_id)[1] == 0x00B]
    assert [bytes(mode.data) for mode in modes] == [bytes((1, 0, 0, 0, 1, 0, 0, 0))] * 2
    bench.wait(1e-3 * SETTLE_MS)
    bench.commands()
    bench.driver.write_torque((0.0, 0.0))
    assert bench.commands() == [Command.SET_INPUT_TORQUE] * 2


def test_an_axis_is_told_its_target_right_after_its_mode(bench: Bench) -> None:
    """Firmware 0.5 takes where the motor is for the target when a mode is set."""
    bench.armed()
    bench.driver.write(TARGET)
    ids = [split_id(message.arbitration_id) for message in bench.bus.sent]
    for node in NODES:
        at = ids.index((node, Command.SET_CONTROLLER_MODE))
        assert ids[at + 1] == (node, Command.SET_INPUT_POS)


def test_no_frame_is_made_anew_in_a_cycle(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.armed()
    monkeypatch.setattr(bench.driver._link, "_send", len)
    made = []
    monkeypatch.setattr(can, "Message", lambda **_: made.append(1))
    for k in range(200):
        bench.wait(0.01)
        gains = MotorTarget(
            (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (30.0 + k, 30.0), (0.05, 0.05 + 1e-3 * k)
        )
        bench.driver.write(gains)
        bench.driver.write_torque((0.1 * k, 0.0))
    assert made == []
    assert bench.driver.write_failures == 0


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1e300, 1e39])
@pytest.mark.parametrize("field", range(5))
def test_a_target_that_is_no_number_is_not_sent(bench: Bench, field: int, bad: float) -> None:
    bench.armed()
    fields = [TARGET.pos_turns, TARGET.vel_turns, TARGET.torque, TARGET.pos_gain, TARGET.vel_gain]
    fields[field] = (0.0, bad)
    bench.driver.write(MotorTarget(*fields))
    assert bench.commands() == []
    assert bench.driver.write_failures == 1


# ---- filters


def test_the_kernel_is_told_which_nodes_to_wake_for(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, "socketcan")
    found = bench.bus.options["can_filters"]
    assert isinstance(found, list)
    passing = {
        can_id
        for can_id in range(1 << 11)
        for each in found
        if can_id & each["can_mask"] == each["can_id"] & each["can_mask"]
    }
    assert passing == {arbitration_id(node, command) for node in NODES for command in range(32)}
    assert all(each["extended"] is False for each in found)
    bench.driver.close()


def test_other_interfaces_filter_nothing(bench: Bench) -> None:
    """In software a filter saves nothing, and would keep error frames away."""
    assert "can_filters" not in bench.bus.options
