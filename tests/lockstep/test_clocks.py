"""Hosts whose clocks disagree, and yesterday's commands on the bus, in virtual time.

Ages are told on one clock, so what other hosts take for the time is in no rule. Live that
clock is the host's monotonic one, which cannot step: no test steps a joint service's.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import pytest

from services.planner.watch.engagement_fsm import WAITS_NS
from shared.bus.messages import Cause, JointCommand, Message, Mode, PlannerStatus, SimTruth
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tests.lockstep import partial
from tests.lockstep.partial import PartialCase
from tools.sim.lockstep import FleetMoment, Lockstep
from tools.sim.virtual_time import HostClock

HOUR_NS = 3600 * NS_PER_S
HOSTS = ("planner", "harness", *MODULES)
SQUAT = partial.scenario_of(PartialCase("links", ()))


class Fleet(Lockstep):
    traced = False


class Run(NamedTuple):
    fleet: Fleet
    rows: list[SimTruth]
    commands: list[JointCommand]
    by_module: dict[str, list[JointCommand]]
    statuses: list[PlannerStatus]

    def left_track(self) -> dict[str, int]:
        """Return the cause for each module that left TRACK."""
        return {m: e.cause for m, e in self.fleet.events if e.mode_before == Mode.TRACK}


def squat(
    robot: RobotConfig,
    seconds: float,
    clocks: dict[str, HostClock] | None = None,
    at_half_time: Callable[[], None] = lambda: None,
) -> Run:
    """Squat for a while; half-way through, something is done."""
    commands: list[JointCommand] = []
    by_module: dict[str, list[JointCommand]] = {name: [] for name in MODULES}
    statuses: list[PlannerStatus] = []

    def record(_topic: Topic, module: str, message: Message) -> None:
        if isinstance(message, JointCommand):
            commands.append(msgspec.structs.replace(message, t_ns=0, echo_t_ns=0))
            by_module[module].append(message)
        elif isinstance(message, PlannerStatus):
            statuses.append(message)

    scenario = msgspec.structs.replace(SQUAT, duration=seconds)
    fleet = Fleet(robot, scenario, record=record, clocks=clocks)
    rows: list[SimTruth] = []
    for row in fleet.run():
        rows.append(row)
        if rows[-1].scenario_s >= seconds / 2:
            at_half_time()
            at_half_time = lambda: None  # noqa: E731
    return Run(fleet, rows, commands, by_module, statuses)


@pytest.fixture(scope="module")
def plain(robot: RobotConfig) -> Run:
    return squat(robot, 1.2)


@pytest.fixture(scope="module")
def start(robot: RobotConfig) -> FleetMoment:
    return partial.start_of(robot)


# ---- hosts that disagree


def test_a_host_clock_counts_from_its_offset_at_its_own_pace_and_can_be_put_on_or_back() -> None:
    clock = HostClock(offset_ns=5, drift_ppm=200.0)
    assert [clock.read(t) for t in (0, NS_PER_S)] == [5, 5 + NS_PER_S + 200_000]
    clock.step(-3)
    assert clock.read(0) == 2


def test_hosts_that_count_from_different_moments_change_not_one_bit(
    robot: RobotConfig, plain: Run
) -> None:
    """Months apart, each joint service on a host of its own."""
    dice = random.Random(1)
    other = squat(robot, 1.2, {host: HostClock(dice.randrange(10**16)) for host in HOSTS})
    assert [msgspec.structs.replace(row, t_ns=0) for row in other.rows] == [
        msgspec.structs.replace(row, t_ns=0) for row in plain.rows
    ]
    assert other.commands == plain.commands
    stamps = {name: other.by_module[name][-1].echo_t_ns for name in MODULES}
    assert len(set(stamps.values())) == len(MODULES), "there were six clocks"


def test_clocks_that_drift_200_ppm_apart_change_nothing_that_matters(
    robot: RobotConfig, plain: Run
) -> None:
    """Not bit for bit: ages and periods are read 0.04 % longer or shorter; play adds to it."""
    clocks = {host: HostClock(HOUR_NS, 200.0 * (-1) ** n) for n, host in enumerate(HOSTS)}
    other = squat(robot, 1.2, clocks)
    apart = [
        abs(a - b)
        for mine, row in zip(other.rows, plain.rows, strict=True)
        for a, b in zip(mine.com, row.com, strict=True)
    ]
    assert max(apart) < 1e-3
    assert other.left_track() == {}
    assert all(not controller.failsafe.refused for controller in other.fleet.controllers)


def test_a_planner_whose_clock_were_put_on_by_an_hour_holds_and_leads_again(
    robot: RobotConfig,
) -> None:
    """It cannot be, on a monotonic clock: all states look an hour old to one tick."""
    clock = HostClock(2 * HOUR_NS)
    other = squat(robot, 2.4, {"planner": clock}, lambda: clock.step(HOUR_NS))
    assert other.left_track() == dict.fromkeys(MODULES, Cause.HOLD_ALL)
    modes = {controller.failsafe.mode for controller in other.fleet.controllers}
    assert modes == {Mode.TRACK}
    held = [status.t_ns for status in other.statuses if status.hold and status.t_ns > 3 * HOUR_NS]
    assert held[-1] - held[0] <= WAITS_NS[1] + 100 * NS_PER_MS
    assert not other.rows[-1].fallen


def test_with_a_planner_whose_clock_were_put_back_by_an_hour_the_robot_holds(
    robot: RobotConfig,
) -> None:
    """It waits for its next tick, an hour long; the age rule does not. A restart mends it."""
    clock = HostClock(2 * HOUR_NS)
    other = squat(robot, 1.2, {"planner": clock}, lambda: clock.step(-HOUR_NS))
    assert other.left_track() == dict.fromkeys(MODULES, Cause.COMMAND_STALE)
    assert not other.rows[-1].fallen


# ---- yesterday's commands


PLAYED = 147
"""Commands to each module."""


def put_again(fleet: Fleet, module: int, sent: JointCommand) -> None:
    """Put a command on the link as if it came from the planner, past the network's own order."""
    fleet.network.commands()[module].put(fleet.now_ns, sent)


def gone_on(robot: RobotConfig, start: FleetMoment, *, led: bool, again: Run | None) -> Fleet:
    """Go on for 0.6 s, with or without a planner, with a record's commands played on top."""
    fleet = Fleet(robot, SQUAT)
    fleet.resume(start if led else msgspec.structs.replace(start, planner=None))
    records = again.by_module if again is not None else {name: [] for name in MODULES}
    rows = [itertools.cycle(records[name] or [None]) for name in MODULES]
    for ms in range(600):
        # between two of the planner's, for the newest arrival alone is kept
        if ms % 4 == 2 and ms < 4 * PLAYED:
            for module, series in enumerate(rows):
                sent = next(series)
                if sent is not None:
                    put_again(fleet, module, sent)
        fleet.advance()
    return fleet


@pytest.mark.parametrize("led", [True, False], ids=["led", "held"])
def test_yesterdays_commands_put_onto_the_bus_move_nothing(
    led: bool, robot: RobotConfig, plain: Run, start: FleetMoment
) -> None:
    """A record of the same robot, same session, in the same pose: older by a day."""
    day_ns = 24 * HOUR_NS
    old = {
        name: [msgspec.structs.replace(c, echo_t_ns=c.echo_t_ns - day_ns) for c in series]
        for name, series in plain.by_module.items()
    }
    ahead = {
        name: [msgspec.structs.replace(c, echo_t_ns=c.echo_t_ns + day_ns) for c in series]
        for name, series in plain.by_module.items()
    }  # the host has been started anew since: its clock is behind the record's
    twin = gone_on(robot, start, led=led, again=None)
    expected = Mode.TRACK if led else Mode.HOLD
    for record in (old, ahead):
        fleet = gone_on(robot, start, led=led, again=plain._replace(by_module=record))
        assert fleet.world.data.qpos.tolist() == twin.world.data.qpos.tolist()
        assert fleet.bank.torque.tolist() == twin.bank.torque.tolist()
        for mine, its in zip(fleet.controllers, twin.controllers, strict=True):
            assert mine.failsafe.mode is its.failsafe.mode is expected
            refused = mine.failsafe.refused - its.failsafe.refused
            assert 0 <= PLAYED - refused <= 2, "at most the two at the ends were overtaken"
