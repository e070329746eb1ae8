"""Hosts whose clocks and counts disagree, in virtual time.

Ages are told on one clock, so what other hosts take for the time is in no rule. Live that
clock is the host's monotonic one, which cannot step: no test steps a joint service's.
"""

from __future__ import annotations

import itertools
import random
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from services.planner.state_phases import COMPARED_TICKS
from services.planner.watch.engagement_fsm import WAITS_NS
from shared.bus.messages import Cause, JointCommand, JointState, Message, Mode, PlannerStatus
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import MODULES
from tests.lockstep import runs
from tests.lockstep.runs import kill, led_to, push, restart, variant
from tests.robots import ROBOT
from tools.sim.lockstep import Lockstep
from tools.sim.virtual_services import HostClock

HOUR_NS = 3600 * NS_PER_S

HOSTS = ("planner", "harness", *MODULES)

PUSH = push(1.2, 28.0, 28.0, 0.0)
SQUAT = led_to((2.5, 0.948), (5.0, 1.188), duration=3.4, push=(PUSH,))


class Run(NamedTuple):
    run: runs.Run
    sent: dict[str, list[JointCommand]]
    """By module."""
    statuses: list[PlannerStatus]

    @property
    def left_track(self) -> dict[str, int]:
        """Return the cause for each module that left TRACK."""
        return {m: e.cause for m, e in self.run.lockstep.events if e.mode_before == Mode.TRACK}

    @property
    def commands(self) -> list[JointCommand]:
        """Return all commands without the stamps of any clock."""
        told = itertools.chain(*self.sent.values())
        return [msgspec.structs.replace(each, t_ns=0, echo_t_ns=0) for each in told]


def squat(seconds: float, clocks: dict[str, HostClock] | None = None, step_ns: int = 0) -> Run:
    """Squat for a while from the hoist on; half-way through, the planner's clock steps."""
    sent: dict[str, list[JointCommand]] = {name: [] for name in MODULES}
    statuses: list[PlannerStatus] = []

    def record(_topic: Topic, module: str, message: Message) -> None:
        if isinstance(message, JointCommand):
            sent[module].append(message)
        elif isinstance(message, PlannerStatus):
            statuses.append(message)

    def step(_fleet: Lockstep, row: SimTruth) -> None:
        nonlocal step_ns
        if clocks and step_ns and row.scenario_s >= seconds / 2:
            clocks["planner"].step(step_ns)
            step_ns = 0

    scenario = msgspec.structs.replace(SQUAT, duration=seconds)
    outcome = runs.run(ROBOT, scenario, stands=False, record=record, clocks=clocks, each=step)
    assert outcome.stood
    return Run(outcome, sent, statuses)


@pytest.fixture(scope="module")
def plain() -> Run:
    return squat(1.2)


def test_a_host_clock_counts_from_its_offset_at_its_own_pace_and_can_be_put_on_or_back() -> None:
    clock = HostClock(offset_ns=5, drift_ppm=200.0)
    assert [clock.read(t) for t in (0, NS_PER_S)] == [5, 5 + NS_PER_S + 200_000]
    clock.step(-3)
    assert clock.read(0) == 2


def test_hosts_offset_by_months_change_not_one_bit(plain: Run) -> None:
    """Months apart, each joint service on a host of its own."""
    dice = random.Random(1)
    other = squat(1.2, {host: HostClock(dice.randrange(10**16)) for host in HOSTS})
    rows, expected = (
        [msgspec.structs.replace(row, t_ns=0) for row in each.run.rows] for each in (other, plain)
    )
    assert rows == expected
    assert other.commands == plain.commands
    stamps = {commands[-1].echo_t_ns for commands in other.sent.values()}
    assert len(stamps) == len(MODULES), "there were six clocks"


def test_clocks_200_ppm_apart_change_nothing_much(plain: Run) -> None:
    """Not bit for bit: ages and periods are read 0.04 % longer or shorter; play adds to it."""
    clocks = {host: HostClock(HOUR_NS, 200.0 * (-1) ** n) for n, host in enumerate(HOSTS)}
    other = squat(1.2, clocks)
    assert np.abs(other.run.com_mm - plain.run.com_mm).max() < 1.0
    assert other.left_track == {}
    assert all(not each.failsafe.refused for each in other.run.lockstep.controllers)


@pytest.mark.parametrize("ahead", [True, False])
def test_a_planner_an_hour_ahead_holds_and_leads_again_and_one_put_back_holds(ahead: bool) -> None:
    """It cannot be, on a monotonic clock: all states look an hour old to one tick.

    Put back, it waits for its next tick, an hour long; the age rule does not. A restart mends it.
    """
    clocks, step_ns = {"planner": HostClock(2 * HOUR_NS)}, HOUR_NS if ahead else -HOUR_NS
    other = squat(2.4 if ahead else 1.2, clocks, step_ns)
    cause = Cause.HOLD_ALL if ahead else Cause.COMMAND_STALE
    assert other.left_track == dict.fromkeys(MODULES, cause)
    if ahead:
        assert set(other.run.modes) == {Mode.TRACK}
        held = [row.t_ns for row in other.statuses if row.hold and row.t_ns > 3 * HOUR_NS]
        assert held[-1] - held[0] <= WAITS_NS[1] + 100 * NS_PER_MS


@pytest.mark.sampled(2)
@pytest.mark.parametrize("skewed", [(1,), (0, 2, 4), (1, 2, 3, 4, 5)])
def test_after_one_comparison_all_are_in_step(skewed: tuple[int, ...]) -> None:
    """Joint services that began to count at different times send in the same period."""
    last: dict[str, int] = {}

    def record(_topic: Topic, module: str, message: Message) -> None:
        if isinstance(message, JointState):
            last[module] = message.t_ns

    restarted = {"kill": kill(0.2), "restart": restart(0.5), "push": ()}
    fleet = Lockstep(ROBOT, variant("stand", duration=1.5, **restarted), record=record)
    for index, joint in enumerate(fleet.joints):
        clock = joint.manager.state.controller.clock
        clock.count, clock.at_ns = 2 - (index in skewed), fleet.now_ns - 2_000_000
    begin_ns, spreads = fleet.now_ns, {}
    for row in fleet.run():
        assert not row.fallen
        if len(last) == len(MODULES):
            spreads[fleet.now_ns - begin_ns] = max(last.values()) - min(last.values())
    compared_ns = (COMPARED_TICKS + 10) * NS_PER_S // 250
    assert max(spreads.values()) == 2_000_000, "they began out of step"
    assert {spread for at_ns, spread in spreads.items() if at_ns > compared_ns} == {0}
