"""What a drive sends: estimates that make a sample, where its motors are, what they hold."""

from __future__ import annotations

import math
import random

import pytest

from services.joint.drivers import odrive_can
from services.joint.drivers.base import DriveReading
from services.joint.drivers.can_link import RETRY_MS
from services.joint.drivers.frame_times import REBOOT_MS, EncoderPair
from services.joint.drivers.odrive_can import OdriveCan
from services.joint.drivers.replies import Replies
from services.simulator.fronts.cansimple_dialects import DialectName
from shared.bus.messages import Pair
from shared.can.cansimple import AxisState, Command, pack_two_floats, pack_two_ints
from shared.clock import NS_PER_MS
from tests.joint.drivers.can_bench import COUNTS_PER_TURN, Bench, receiving_fails
from tests.joint.drivers.rig import DRIVE, NODES, Rig, Shed, arm

ZERO = (0.0, 0.0)

COUNTED = (0.5, -64.25)


def receive_estimates(bench: Bench, turns: Pair) -> DriveReading:
    """Have both axes send an estimate, without velocity, and read them."""
    for node, pos in zip(NODES, turns, strict=True):
        bench.send(node, Command.GET_ENCODER_ESTIMATES, pack_two_floats(pos, 0.0))
    return bench.seen(1)


def renew_the_link(bench: Bench) -> None:
    receiving_fails(bench)
    bench.after(1)
    bench.after(RETRY_MS)
    assert len(bench.buses) > 1


def receive_counts(bench: Bench) -> None:
    for node, turns in zip(NODES, COUNTED, strict=True):
        data = pack_two_ints(round(turns * COUNTS_PER_TURN), 0)
        bench.send(node, Command.GET_ENCODER_COUNT, data)


def test_a_count_is_forgotten_with_a_restart_the_link_and_in_a_long_silence(bench: Bench) -> None:
    """A drive with other estimates than zeros is asked for none."""
    forgets = {
        "a restart": lambda: receive_estimates(bench, (0.6, -64.0)),
        "the link": lambda: renew_the_link(bench),
        "a silence": lambda: bench.after(REBOOT_MS + 1),
    }
    for why, forget in forgets.items():
        receive_counts(bench)
        assert receive_estimates(bench, ZERO).pos_turns == COUNTED
        forget()
        assert receive_estimates(bench, ZERO).pos_turns == ZERO, why
    receive_estimates(bench, (0.25, 0.25))
    bench.commands()
    assert receive_estimates(bench, (0.25, 0.25)).pos_turns == (0.25, 0.25)
    assert bench.commands() == []


def receive_currents(bench: Bench, *currents: float) -> Pair | None:
    """Have axes send their current; return the torques that are read with the next sample."""
    for node, current in zip(NODES, currents, strict=False):
        bench.send(node, Command.GET_IQ, pack_two_floats(current, 0.0))
    return bench.receive(None).torque


def test_the_current_is_asked_for_again_over_a_new_link(bench: Bench) -> None:
    bench.receive(AxisState.CLOSED_LOOP_CONTROL)
    assert receive_currents(bench, float("nan"), 1.0) is None, "that is no reply"
    held = pytest.approx((2.0 * DRIVE.torque_constant, DRIVE.torque_constant))
    assert receive_currents(bench, 2.0) == held
    renew_the_link(bench)
    bench.commands()
    assert bench.receive(AxisState.CLOSED_LOOP_CONTROL).torque is None
    assert Command.GET_IQ in bench.commands()


def test_a_drive_armed_by_this_driver_reports_no_torques(rig: Rig, driver: OdriveCan) -> None:
    arm(rig, driver, onboard=True)
    for _ in range(10):
        assert rig.cycle(driver).torque is None


# ---- which estimates of two axes make a sample

PERIOD_NS = 2_000_000

BEHIND_NS = 130_000
"""Axis1's frame comes after axis0's, back to back on a bus of 1 Mbit/s."""


def run(
    cycles: int,
    lost: set[tuple[int, int]],
    phase_ns: int = BEHIND_NS,
    jitter_ns: int = 0,
    period_ns: tuple[int, int] = (PERIOD_NS, PERIOD_NS),
) -> list[tuple[float, float]]:
    """Return the samples, as cycle numbers of (axis0, axis1); `lost` names (cycle, axis)."""
    dice = random.Random(1)
    frames = [
        (10**9 + k * period_ns[axis] + axis * phase_ns + dice.randint(0, jitter_ns), k, axis)
        for k in range(cycles)
        for axis in (0, 1)
        if (k, axis) not in lost
    ]
    pair = EncoderPair()
    samples = []
    for now_ns, k, axis in sorted(frames):
        pair.store(axis, (float(k), 0.0), now_ns)
        if pair.complete():
            (a, _), (b, _) = pair.estimates
            samples.append((a, b))
    return samples


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("cycle", [3, 4])
def test_after_a_lost_frame_the_axes_are_of_the_same_period_again(cycle: int, axis: int) -> None:
    samples = run(20, {(cycle, axis)})
    torn = [sample for sample in samples if sample[0] != sample[1]]
    assert len(torn) <= 1
    assert samples[-10:] == [(float(k), float(k)) for k in range(10, 20)]


def test_without_loss_every_period_makes_one_sample() -> None:
    assert run(50, set()) == [(float(k), float(k)) for k in range(50)]


@pytest.mark.parametrize("share", [0.1, 0.3, 0.45, 0.5, 0.55, 0.7, 0.95])
def test_axes_out_of_step_make_as_many_samples_and_the_tightest(share: float) -> None:
    """As two boards of firmware 0.6 are, each with its own clock."""
    samples = run(200, set(), round(share * PERIOD_NS), jitter_ns=PERIOD_NS // 50)
    assert len(samples) >= 190
    if share < 0.4:
        assert all(a == b for a, b in samples[5:])
    if share > 0.6:
        assert all(a == b + 1 for a, b in samples[5:])


def test_axes_whose_clocks_drift_past_each_other_never_stop_making_samples() -> None:
    slow = round(1.01 * PERIOD_NS)
    assert len(run(1000, set(), period_ns=(PERIOD_NS, slow))) >= 970


def test_frames_that_waited_together_make_a_sample_of_the_newest_number() -> None:
    pair = EncoderPair()
    for k in range(5):
        for axis in (0, 1):
            pair.store(axis, (float(k), 0.0), 10**9)
    assert pair.complete()
    for bad in ((math.nan, 0.0), (0.0, math.inf)):
        assert not pair.complete()
        assert pair.estimates == [(4.0, 0.0), (4.0, 0.0)]
        for axis in (0, 1):
            pair.store(axis, bad, 10**9)


@pytest.mark.parametrize("dialect", ["0.5", "0.6"])
def test_the_voltage_of_the_supply_is_asked_for_now_and_then(
    shed: Shed, dialect: DialectName, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(odrive_can, "SUPPLY_EVERY_NS", 5 * NS_PER_MS)
    rig = shed.rig(dialect=dialect)
    rig.bank.bus.supply[2] = 43.5
    rig.bank.bus.changed()
    driver = shed.connected(rig)
    assert rig.cycle(driver).supply_v == 0.0, "not known yet"
    for _ in range(20):  # an answer may find the drive's mailboxes full
        rig.cycle(driver)
    assert rig.cycle(driver).supply_v == pytest.approx(43.5, abs=0.01)


@pytest.mark.parametrize("volts", [math.nan, math.inf, -1.0])
def test_a_voltage_that_is_none_is_not_believed(volts: float) -> None:
    replies = Replies(NODES, 0.08, None)
    replies.take_supply(0, pack_two_floats(volts, 0.0))
    replies.take_supply(0, b"")
    assert replies.supply_v == 0.0
