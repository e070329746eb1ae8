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

from shared.bus.messages import JointCommand, Message, Mode, PlannerStatus
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.joints import MODULES
from tests.lockstep import runs
from tests.lockstep.runs import led_to, push
from tests.robots import ROBOT
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


def squat(seconds: float, clocks: dict[str, HostClock] | None = None) -> Run:
    """Squat for a while from the hoist on."""
    sent: dict[str, list[JointCommand]] = {name: [] for name in MODULES}
    statuses: list[PlannerStatus] = []

    def record(_topic: Topic, module: str, message: Message) -> None:
        if isinstance(message, JointCommand):
            sent[module].append(message)
        elif isinstance(message, PlannerStatus):
            statuses.append(message)

    scenario = msgspec.structs.replace(SQUAT, duration=seconds)
    outcome = runs.run(ROBOT, scenario, stands=False, record=record, clocks=clocks)
    assert outcome.stood
    return Run(outcome, sent, statuses)


@pytest.fixture(scope="module")
def plain() -> Run:
    return squat(1.2)


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
