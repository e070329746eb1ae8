"""Orders to a drive when the queue to the bus is full."""

from __future__ import annotations

import itertools
import time

import can
import pytest

from services.joint.drivers.can_link import COMMANDS_MS, RETRY_MS
from shared.can.cansimple import Command
from tests.joint.drivers.can_bench import Bench
from tests.joint.drivers.rig import TARGET


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
    bench.wait(1e-3 * COMMANDS_MS + 1e-3)
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
