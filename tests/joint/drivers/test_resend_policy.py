"""What goes to a drive, when and in which order, on a full bus too: orders, modes, gains."""

from __future__ import annotations

import itertools
import time

import can
import msgspec
import pytest

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.can_link import COMMANDS_MS, RETRY_MS
from services.joint.drivers.resend_policy import DRIFT_MS, GAINS_MS, SETTLE_MS
from shared.can.cansimple import AxisState, Command, split_id
from tests.joint.drivers.can_bench import Bench
from tests.joint.drivers.rig import NODES, TARGET

GAINS: list[int] = [Command.SET_POS_GAIN, Command.SET_VEL_GAINS, Command.SET_INPUT_POS]

INPUTS: list[int] = [Command.SET_INPUT_POS]


def with_gain(pos_gain: float) -> MotorTarget:
    return msgspec.structs.replace(TARGET, pos_gain=(pos_gain,) * 2)


@pytest.fixture
def settled(bench: Bench) -> Bench:
    bench.armed()
    for _ in range(SETTLE_MS // GAINS_MS + 1):
        bench.driver.write(TARGET)
        bench.wait(1.1e-3 * GAINS_MS)
    bench.driver.write(TARGET)
    bench.wait(2e-3 * DRIFT_MS)
    bench.commands()
    return bench


def written(bench: Bench, target: MotorTarget) -> list[int]:
    """Write a target and return the commands to the second node."""
    bench.driver.write(target)
    bench.wait(0.002)
    return [command for node, command in bench.sent() if node == NODES[1]]


def test_changed_gains_are_sent_twice_and_then_now_and_then(settled: Bench) -> None:
    """Those that drift not twice as often: a blend changes them every few cycles, on a shared bus.

    An axis gets its gains right before the target that they belong to.
    """
    sent = [written(settled, with_gain(10.0)) for _ in range(GAINS_MS // 2 + 4)]
    assert sent[:3] == [GAINS, GAINS, INPUTS]
    assert 3 <= sent.count(GAINS) <= 4
    sent = [written(settled, with_gain(20.0 + step // 3)) for step in range(60)]
    assert 20 <= sent.count(GAINS) <= 22
    settled.wait(2e-3 * DRIFT_MS)
    settled.driver.write(with_gain(10.0))
    assert settled.sent() == [(node, command) for node in NODES for command in GAINS]


def test_gains_that_change_while_the_drive_settles_are_sent_without_the_mode(bench: Bench) -> None:
    """Each mode that is set takes a 0.5 drive's target away, until the next frame."""
    bench.armed()
    sent = [written(bench, with_gain(10.0 + step)) for step in range(SETTLE_MS // 2)]
    modes = sum(Command.SET_CONTROLLER_MODE in row for row in sent)
    assert modes == SETTLE_MS // GAINS_MS


def test_targets_that_a_full_queue_cuts_off_reach_both_axes_in_turn(settled: Bench) -> None:
    received = dict.fromkeys(NODES, 0)
    for step in range(40):
        settled.bus.room = 3
        settled.driver.write(with_gain(10.0 + step))
        settled.wait(0.002)
        for node, command in settled.sent():
            received[node] += command == Command.SET_INPUT_POS
    assert list(received.values()) == [20, 20]


def test_gains_that_a_full_queue_cuts_off_are_sent_again_but_not_after_targets_alone(
    settled: Bench,
) -> None:
    """A queue that is full for two frames is not helped by six."""
    settled.bus.room = 3
    settled.driver.write(with_gain(10.0))
    assert settled.driver.write_failures == 1
    settled.bus.room = 100
    settled.commands()
    settled.driver.write(with_gain(10.0))
    assert settled.commands().count(Command.SET_POS_GAIN) == 2
    settled.wait(1.1e-3 * GAINS_MS)
    settled.driver.write(with_gain(10.0))
    settled.wait(0.002)
    settled.commands()
    settled.bus.room = 1
    settled.driver.write(with_gain(10.0))
    settled.wait(0.002)
    settled.commands()
    settled.bus.room = 100
    assert written(settled, with_gain(10.0)) == INPUTS


def test_limits_and_modes_are_sent_for_a_while_after_arming_and_then_no_more(bench: Bench) -> None:
    bench.armed()
    modes = []
    for _ in range(0, 3 * SETTLE_MS, 10):
        bench.wait(0.01)
        bench.driver.write(TARGET)
        sent = bench.commands()
        modes.append(sent.count(Command.SET_CONTROLLER_MODE))
        assert sent.count(Command.SET_LIMITS) == modes[-1]
    assert sum(modes) == pytest.approx(2 * SETTLE_MS / GAINS_MS, abs=2)
    assert not any(modes[-100:])


def test_modes_are_sent_again_with_torques_too(bench: Bench) -> None:
    bench.armed(onboard=False)
    bench.driver.write_torque((0.0, 0.0))
    modes = [m for m in bench.bus.sent if split_id(m.arbitration_id)[1] == 0x00B]
    assert [bytes(mode.data) for mode in modes] == [bytes((1, 0, 0, 0, 1, 0, 0, 0))] * 2
    bench.wait(1e-3 * SETTLE_MS)
    bench.commands()
    bench.driver.write_torque((0.0, 0.0))
    assert bench.commands() == [Command.SET_INPUT_TORQUE] * 2


def test_an_axis_gets_its_target_right_after_its_mode_and_no_limit_if_it_was_found_armed(
    bench: Bench,
) -> None:
    """Firmware 0.5 takes where the motor is for the target when a mode is set.

    A drive that was found armed could be above a limit.
    """
    modes = {Command.SET_CONTROLLER_MODE, Command.SET_LIMITS}
    bench.receive(AxisState.CLOSED_LOOP_CONTROL)
    for _ in range(2):
        bench.driver.write(TARGET)
        bench.wait(2e-3 * GAINS_MS)
    assert not modes & set(bench.commands())
    bench.driver.idle()
    bench.receive()
    bench.armed()
    bench.driver.write(TARGET)
    ids = bench.sent()
    for node in NODES:
        at = ids.index((node, Command.SET_CONTROLLER_MODE))
        assert ids[at + 1] == (node, Command.SET_INPUT_POS)


# ---- orders when the queue is full


def test_arming_goes_on_as_the_queue_empties_closed_loop_last(bench: Bench) -> None:
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


@pytest.mark.parametrize("waits_s", [0.0, 1e-3 * COMMANDS_MS + 1e-3])
def test_an_order_takes_the_place_of_one_that_waits_and_one_that_waited_too_long_is_given_up(
    bench: Bench, waits_s: float
) -> None:
    """A drive must not arm long after it was asked to."""
    bench.receive()
    bench.commands()
    bench.bus.room = 0
    bench.driver.arm(onboard=True)
    if not waits_s:
        bench.driver.idle()
    bench.wait(waits_s)
    bench.bus.room = 100
    bench.after(1)
    idling = [*[Command.SET_INPUT_TORQUE] * 2, *[Command.SET_AXIS_STATE] * 2]
    assert bench.commands() == ([] if waits_s else idling)


def test_an_order_does_not_go_to_the_next_bus(bench: Bench) -> None:
    bench.wait(1e-3 * RETRY_MS)
    bench.receive()
    bench.bus.room = 0
    bench.driver.arm(onboard=True)
    bench.bus.waiting.append(can.CanOperationError("Failed to receive"))
    bench.after(1)
    bench.after(1)
    assert len(bench.buses) == 2, "at once: it had been open for long"
    assert Command.SET_AXIS_STATE not in bench.commands()


def test_closing_waits_for_the_order_to_idle(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.armed()
    bench.bus.room = 0
    bench.driver.idle()

    def drain(seconds: float) -> None:
        bench.wait(seconds)
        bench.bus.room = 2

    monkeypatch.setattr(time, "sleep", drain)
    bench.driver.close()
    assert bench.commands()[-2:] == [Command.SET_AXIS_STATE] * 2
