"""Hosts whose clocks and counts disagree, and yesterday's commands on the bus, in virtual time.

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
from shared.bus import topics
from shared.bus.messages import Cause, JointCommand, JointState, Message, Mode, PlannerStatus
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import MODULES
from tests.lockstep import runs
from tests.lockstep.runs import kill, led_to, modes_of, moment_of, push, restart, variant
from tests.robots import ROBOT
from tools.sim.lockstep import FleetMoment, Lockstep
from tools.sim.virtual_time import HostClock

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


@pytest.fixture(scope="module")
def start() -> FleetMoment:
    return moment_of(ROBOT, SQUAT, 0.9)


def test_a_host_clock_counts_from_its_offset_at_its_own_pace_and_can_be_put_on_or_back() -> None:
    clock = HostClock(offset_ns=5, drift_ppm=200.0)
    assert [clock.read(t) for t in (0, NS_PER_S)] == [5, 5 + NS_PER_S + 200_000]
    clock.step(-3)
    assert clock.read(0) == 2


def without_stamp(rows: list[SimTruth]) -> list[SimTruth]:
    return [msgspec.structs.replace(row, t_ns=0) for row in rows]


def test_hosts_offset_by_months_change_not_one_bit(plain: Run) -> None:
    """Months apart, each joint service on a host of its own."""
    dice = random.Random(1)
    other = squat(1.2, {host: HostClock(dice.randrange(10**16)) for host in HOSTS})
    assert without_stamp(other.run.rows) == without_stamp(plain.run.rows)
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


def test_a_planner_an_hour_ahead_holds_and_leads_again() -> None:
    """It cannot be, on a monotonic clock: all states look an hour old to one tick."""
    clock = HostClock(2 * HOUR_NS)
    other = squat(2.4, {"planner": clock}, HOUR_NS)
    assert other.left_track == dict.fromkeys(MODULES, Cause.HOLD_ALL)
    assert set(other.run.modes) == {Mode.TRACK}
    held = [status.t_ns for status in other.statuses if status.hold and status.t_ns > 3 * HOUR_NS]
    assert held[-1] - held[0] <= WAITS_NS[1] + 100 * NS_PER_MS


def test_with_a_planner_put_back_by_an_hour_it_holds() -> None:
    """It waits for its next tick, an hour long; the age rule does not. A restart mends it."""
    clock = HostClock(2 * HOUR_NS)
    other = squat(1.2, {"planner": clock}, -HOUR_NS)
    assert other.left_track == dict.fromkeys(MODULES, Cause.COMMAND_STALE)


PLAYED = 147
"""Commands to each module."""


def gone_on(start: FleetMoment, *, led: bool, again: Run | None = None, by_ns: int = 0) -> Lockstep:
    """Go on for 0.6 s, with or without a planner, with a record's commands played on top.

    They are put past the network's own order, as if they came from the planner.
    """
    fleet = Lockstep(ROBOT, SQUAT)
    fleet.resume(start if led else msgspec.structs.replace(start, planner=None))
    played = [] if again is None else [itertools.cycle(again.sent[name]) for name in MODULES]
    for ms in range(600):
        # between two of the planner's, for the newest arrival alone is kept
        if ms % 4 == 2 and ms < 4 * PLAYED:
            for module, sent in enumerate(map(next, played)):
                moved = msgspec.structs.replace(sent, echo_t_ns=sent.echo_t_ns + by_ns)
                fleet.network.commands()[module].put(fleet.now_ns, moved)
        fleet.advance()
    return fleet


@pytest.mark.parametrize("led", [True, False], ids=["led", "held"])
def test_yesterdays_commands_put_onto_the_bus_move_nothing(
    led: bool, plain: Run, start: FleetMoment
) -> None:
    """A record of the same robot, same session, in the same pose: older by a day.

    Or ahead by one: the host has restarted since, so its clock is behind the record's.
    """
    twin = gone_on(start, led=led)
    for days in (-1, 1):
        fleet = gone_on(start, led=led, again=plain, by_ns=days * 24 * HOUR_NS)
        assert fleet.world.data.qpos.tolist() == twin.world.data.qpos.tolist()
        assert fleet.bank.torque.tolist() == twin.bank.torque.tolist()
        assert modes_of(fleet) == modes_of(twin) == [Mode.TRACK if led else Mode.HOLD] * 6
        for mine, its in zip(fleet.controllers, twin.controllers, strict=True):
            refused = mine.failsafe.refused - its.failsafe.refused
            assert 0 <= PLAYED - refused <= 2, "at most the two at the ends were overtaken"


class Sent:
    """When each module sent its last states."""

    def __init__(self) -> None:
        self.at: dict[str, list[int]] = {name: [] for name in MODULES}

    def __call__(self, topic: Topic, module: str, message: Message) -> None:
        if topic is topics.JOINT_STATE and isinstance(message, JointState):
            self.at[module].append(message.t_ns)

    def spread_ns(self) -> int:
        last = [times[-1] for times in self.at.values()]
        return max(last) - min(last)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("skewed", [(1,), (0, 2, 4), (1, 2, 3, 4, 5)])
def test_after_one_comparison_all_are_in_step(skewed: tuple[int, ...]) -> None:
    """Joint services that began to count at different times send in the same period."""
    sent = Sent()
    restarted = {"kill": kill(0.2), "restart": restart(0.5), "push": ()}
    fleet = Lockstep(ROBOT, variant("stand", duration=1.5, **restarted), record=sent)
    for index, joint in enumerate(fleet.joints):
        clock = joint.manager.controller._state.clock
        clock.count, clock.at_ns = 2 - (index in skewed), fleet.now_ns - 2_000_000
    begin_ns, spreads = fleet.now_ns, {}
    for row in fleet.run():
        assert not row.fallen
        if all(sent.at.values()):
            spreads[fleet.now_ns - begin_ns] = sent.spread_ns()
    compared_ns = (COMPARED_TICKS + 10) * NS_PER_S // 250
    assert max(spreads.values()) == 2_000_000, "they began out of step"
    assert {spread for at_ns, spread in spreads.items() if at_ns > compared_ns} == {0}
