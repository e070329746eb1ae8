"""What the CAN driver tells a drive along with its targets, how often and in which order."""

from __future__ import annotations

from services.joint.drivers.base import MotorTarget
from services.joint.drivers.resend_policy import DRIFT_MS, GAINS_MS, SETTLE_MS
from shared.can.cansimple import Command, split_id
from tests.joint.drivers.can_bench import TARGET, Bench, bench
from tests.joint.drivers.test_odrive_can import NODES

__all__ = ["bench"]  # fixtures

GAINS = [Command.SET_POS_GAIN, Command.SET_VEL_GAINS, Command.SET_INPUT_POS]
INPUTS = [Command.SET_INPUT_POS]


def with_gain(pos_gain: float) -> MotorTarget:
    return MotorTarget(
        TARGET.pos_turns, TARGET.vel_turns, TARGET.torque, (pos_gain,) * 2, TARGET.vel_gain
    )


def settled(bench: Bench) -> None:
    bench.armed()
    for _ in range(SETTLE_MS // GAINS_MS + 1):
        bench.driver.write(TARGET)
        bench.wait(1.1e-3 * GAINS_MS)
    bench.driver.write(TARGET)
    bench.wait(2e-3 * DRIFT_MS)
    bench.commands()


def written(bench: Bench, target: MotorTarget, ms: float = 2.0) -> list[int]:
    """Write a target and return the commands to the second node."""
    bench.driver.write(target)
    bench.wait(1e-3 * ms)
    ids = [split_id(message.arbitration_id) for message in bench.bus.sent]
    bench.bus.sent.clear()
    return [command for node, command in ids if node == NODES[1]]


def test_gains_that_change_are_told_twice_and_then_now_and_then(bench: Bench) -> None:
    settled(bench)
    told = [written(bench, with_gain(10.0)) for _ in range(GAINS_MS // 2 + 4)]
    assert told[:3] == [GAINS, GAINS, INPUTS]
    assert 3 <= told.count(GAINS) <= 4


def test_gains_that_drift_are_not_told_twice_as_often(bench: Bench) -> None:
    """A blend changes them every few cycles: one bus of all six modules would be full of them."""
    settled(bench)
    told = [written(bench, with_gain(10.0 + step // 3)) for step in range(60)]
    assert 20 <= told.count(GAINS) <= 22


def test_an_axis_gets_its_gains_right_before_the_target_they_belong_to(bench: Bench) -> None:
    settled(bench)
    bench.driver.write(with_gain(10.0))
    ids = [split_id(message.arbitration_id) for message in bench.bus.sent]
    assert ids == [(node, command) for node in NODES for command in GAINS]


def test_gains_that_change_while_the_drive_settles_bring_no_mode_with_them(bench: Bench) -> None:
    """Each mode that is set takes a 0.5 drive's target away, until the next frame."""
    bench.armed()
    told = [written(bench, with_gain(10.0 + step)) for step in range(SETTLE_MS // 2)]
    modes = sum(Command.SET_CONTROLLER_MODE in row for row in told)
    assert modes == SETTLE_MS // GAINS_MS


def test_rows_that_a_full_queue_cuts_off_reach_both_axes_in_turn(bench: Bench) -> None:
    settled(bench)
    heard = dict.fromkeys(NODES, 0)
    for step in range(40):
        bench.bus.room = 3
        bench.driver.write(with_gain(10.0 + step))
        bench.wait(0.002)
        for message in bench.bus.sent:
            node, command = split_id(message.arbitration_id)
            heard[node] += command == Command.SET_INPUT_POS
        bench.bus.sent.clear()
    assert list(heard.values()) == [20, 20]


def test_targets_alone_that_were_cut_off_bring_no_gains_after_them(bench: Bench) -> None:
    """A queue that is full for two frames is not helped by six."""
    settled(bench)
    bench.bus.room = 1
    bench.driver.write(TARGET)
    bench.wait(0.002)
    bench.bus.sent.clear()
    bench.bus.room = 100
    assert written(bench, TARGET) == INPUTS
