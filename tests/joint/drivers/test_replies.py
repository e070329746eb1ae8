"""Replies of a drive to requests: where its motors are, and what they hold."""

from __future__ import annotations

import pytest

from services.joint.drivers.base import DriveReading
from services.joint.drivers.odrive_can import (
    REBOOT_MS,
    RETRY_MS,
    OdriveCan,
)
from shared.bus.messages import Pair
from shared.can.cansimple import (
    AxisState,
    Command,
    pack_two_floats,
    pack_two_ints,
)
from shared.config.sections import CanConfig
from tests.joint.drivers.can_bench import Bench, frame, receiving_fails
from tests.joint.drivers.rig import DRIVE, NODES, Rig, arm

COUNTS_PER_TURN = 1000
ZERO = (0.0, 0.0)
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


def receive_estimates(bench: Bench, turns: Pair) -> DriveReading:
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


def receive_counts(bench: Bench) -> None:
    for node, turns in zip(NODES, COUNTED, strict=True):
        data = pack_two_ints(round(turns * COUNTS_PER_TURN), 0)
        bench.bus.waiting.append(frame(node, Command.GET_ENCODER_COUNT, data))


def test_a_drive_whose_estimates_are_zero_is_asked_for_its_counts(
    counting: Bench,
) -> None:
    counting.commands()
    assert receive_estimates(counting, ZERO).pos_turns == ZERO
    assert counting.commands().count(Command.GET_ENCODER_COUNT) == 2
    receive_counts(counting)
    reading = receive_estimates(counting, ZERO)
    assert (reading.pos_turns, reading.vel_turns) == (COUNTED, (0.0, 0.0))


def test_a_drive_with_other_estimates_is_asked_for_no_count(counting: Bench) -> None:
    receive_estimates(counting, (0.25, 0.25))
    counting.commands()
    assert receive_estimates(counting, (0.25, 0.25)).pos_turns == (0.25, 0.25)
    assert counting.commands() == []


def test_a_count_from_before_a_restart_is_not_believed_after_it(counting: Bench) -> None:
    receive_counts(counting)
    assert receive_estimates(counting, ZERO).pos_turns == COUNTED
    receive_estimates(counting, (0.6, -64.0))
    assert receive_estimates(counting, ZERO).pos_turns == ZERO


def test_a_count_is_forgotten_with_the_link_and_in_a_long_silence(counting: Bench) -> None:
    receive_counts(counting)
    assert receive_estimates(counting, ZERO).pos_turns == COUNTED
    renew_the_link(counting)
    assert receive_estimates(counting, ZERO).pos_turns == ZERO
    receive_counts(counting)
    assert receive_estimates(counting, ZERO).pos_turns == COUNTED
    counting.after(REBOOT_MS + 1)
    assert receive_estimates(counting, ZERO).pos_turns == ZERO


def test_the_current_is_asked_for_again_over_a_new_link(bench: Bench) -> None:
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


def test_a_current_that_is_no_number_is_no_reply(bench: Bench) -> None:
    bench.receive(AxisState.CLOSED_LOOP_CONTROL)
    for node, current in zip(NODES, (float("nan"), 1.0), strict=True):
        bench.bus.waiting.append(frame(node, Command.GET_IQ, pack_two_floats(current, 0.0)))
    reading = bench.receive(None)
    assert reading is not None
    assert reading.torque is None
    bench.bus.waiting.append(frame(NODES[0], Command.GET_IQ, pack_two_floats(2.0, 0.0)))
    reading = bench.receive(None)
    assert reading is not None
    assert reading.torque is not None


def test_a_drive_armed_by_this_driver_reports_no_torques(rig: Rig, driver: OdriveCan) -> None:
    arm(rig, driver, onboard=True)
    for _ in range(10):
        assert rig.cycle(driver).torque is None
