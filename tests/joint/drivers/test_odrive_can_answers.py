"""What the CAN driver makes of answers: where a drive is that does not say so, what it holds."""

from __future__ import annotations

import pytest

from services.joint.drivers.base import DriveReading
from services.joint.drivers.odrive_can import REBOOT_MS, RETRY_MS, OdriveCan
from shared.bus.messages import Pair
from shared.can.cansimple import AxisState, Command, pack_two_floats, pack_two_ints
from shared.config.sections import CanConfig
from tests.joint.drivers.can_bench import Bench, bench, frame
from tests.joint.drivers.test_odrive_can import DRIVE, NODES
from tests.joint.drivers.test_odrive_can_link import receiving_fails

__all__ = ["bench"]  # fixtures

COUNTS_PER_TURN = 1000
NOTHING = (0.0, 0.0)
COUNTED = (0.5, -64.25)


@pytest.fixture
def counting(bench: Bench) -> Bench:
    """Return the bench with a driver that knows the encoders' counts to a turn."""
    bench.driver.close()
    bench.driver = OdriveCan(
        CanConfig(interface="fake", channel="can7"),
        NODES,
        DRIVE,
        encoder_counts_per_turn=COUNTS_PER_TURN,
    )
    return bench


def say(bench: Bench, turns: Pair) -> DriveReading:
    """Have both axes send an estimate, without velocity, and read them."""
    for node, pos in zip(NODES, turns, strict=True):
        data = pack_two_floats(pos, 0.0)
        bench.bus.waiting.append(frame(node, Command.GET_ENCODER_ESTIMATES, data))
    reading = bench.after(1)
    assert reading is not None
    return reading


def renew_the_link(bench: Bench) -> None:
    receiving_fails(bench)
    bench.after(1)
    bench.after(RETRY_MS)
    assert len(bench.buses) > 1


def tell_counts(bench: Bench) -> None:
    for node, turns in zip(NODES, COUNTED, strict=True):
        data = pack_two_ints(round(turns * COUNTS_PER_TURN), 0)
        bench.bus.waiting.append(frame(node, Command.GET_ENCODER_COUNT, data))


def test_a_drive_whose_estimates_say_nothing_is_asked_for_its_counts_and_is_there(
    counting: Bench,
) -> None:
    counting.commands()
    assert say(counting, NOTHING).pos_turns == NOTHING
    assert counting.commands().count(Command.GET_ENCODER_COUNT) == 2
    tell_counts(counting)
    reading = say(counting, NOTHING)
    assert (reading.pos_turns, reading.vel_turns) == (COUNTED, (0.0, 0.0))


def test_a_drive_whose_estimates_are_there_is_asked_for_no_count(counting: Bench) -> None:
    say(counting, (0.25, 0.25))
    counting.commands()
    assert say(counting, (0.25, 0.25)).pos_turns == (0.25, 0.25)
    assert counting.commands() == []


def test_a_count_from_before_a_restart_is_not_believed_after_it(counting: Bench) -> None:
    tell_counts(counting)
    assert say(counting, NOTHING).pos_turns == COUNTED
    say(counting, (0.6, -64.0))
    assert say(counting, NOTHING).pos_turns == NOTHING


def test_a_count_is_forgotten_with_the_link_and_in_a_long_silence(counting: Bench) -> None:
    tell_counts(counting)
    assert say(counting, NOTHING).pos_turns == COUNTED
    renew_the_link(counting)
    assert say(counting, NOTHING).pos_turns == NOTHING
    tell_counts(counting)
    assert say(counting, NOTHING).pos_turns == COUNTED
    counting.after(REBOOT_MS + 1)
    assert say(counting, NOTHING).pos_turns == NOTHING


def test_what_a_drive_holds_is_asked_for_anew_over_a_new_link(bench: Bench) -> None:
    bench.receive(AxisState.CLOSED_LOOP_CONTROL)
    for node in NODES:
        bench.bus.waiting.append(frame(node, Command.GET_IQ, pack_two_floats(2.0, 0.0)))
    reading = bench.receive(None)
    assert reading is not None
    assert reading.torque == pytest.approx((2.0 * DRIVE.torque_constant,) * 2)
    renew_the_link(bench)
    bench.commands()
    reading = bench.receive(AxisState.CLOSED_LOOP_CONTROL)
    assert reading is not None
    assert reading.torque is None
    assert Command.GET_IQ in bench.commands()
