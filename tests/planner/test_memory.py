"""The planner and each part of it go on from their state bit for bit, shared with nobody."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from services.planner.intents import OperatorRequest
from services.planner.law.coupling import CoupledTorque, PushIntegral
from services.planner.law.levelling import Levelling, up_of
from services.planner.law.load import Load
from services.planner.law.shift import ShiftReference
from services.planner.planner import Planner, PlannerState
from services.planner.state_phases import StatePhases
from services.planner.watch.trips import PlannerTrips
from services.planner.watch.unattended import HAND_LOST_NS, Unattended
from shared.arrays import Array
from shared.bus.messages import STRAIGHT, DriveStatus, Mode, Trip
from shared.config.robot_config import RobotConfig
from shared.joints import N_MODULES
from shared.robot.trip_table import PLANNER_TRIPS
from tests.planner.conftest import Closed
from tests.planner.states import DT, SESSION, START_NS, TICK_NS, receive_all, state

UP = np.array((0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
P, REST = np.array([0.0, 0.0, 0.9, 0.0, 0.1, 0.0]), np.zeros(6)
APART = tuple({Trip.LEGS: 0.2, Trip.UNLOADED: 200.0}.get(trip, 0.0) for trip in PLANNER_TRIPS)
"""Legs that disagree."""
STATE = state(0, np.zeros(12))


class Part(NamedTuple):
    """A part with a state: how it is made, and what a tick does to it."""

    make: Callable[[RobotConfig], Any]
    tick: Callable[[Any, int], Any]
    """Goes on by the tick of a number; what it returns is compared."""
    ticks: int = 100


def weigh(load: Load, tick: int, kg: float) -> Any:
    force = (0.3 * 700.0 if tick < 25 else 700.0 + 9.81 * kg) * UP
    load.advance(force, UP, 0.002 * tick, (0.0, 0.0), DT, led=False)
    return load.refused, load.refusal(), load.state.kg, load.state.a, load.state.b


def couple(coupled: CoupledTorque, tick: int) -> Any:
    coupled.integral.advance(1e-5 * tick, 0.0, DT)
    return tuple(coupled.advance(np.full(12, coupled.integral.force + tick), DT))


def shift(follower: ShiftReference, tick: int) -> Any:
    follower.advance((0.03, -0.04, 0.0, 0.1) if tick < 40 else STRAIGHT, DT)
    p, pdot = np.zeros(6), np.zeros(6)
    follower.add_to(p, pdot)
    return *p, *pdot


def level(levelling: Levelling, tick: int) -> Any:
    told = up_of((0.05, 0.01) if tick < 50 else (0.02, 0.0))
    levelling.advance(told, np.zeros(3), DT, jump=True)
    return *levelling.slope, *levelling.up


def trip(trips: PlannerTrips, tick: int) -> Any:
    trips.advance(START_NS + tick * TICK_NS, APART, leads=True)
    return trips.state.tripped, trips.state.why


def drift(watch: Unattended, tick: int) -> Any:
    now_ns, hand_n = START_NS + tick * HAND_LOST_NS // 20, 50.0 * (tick < 5)
    drifted = watch.advance(now_ns, (0.8, 0.01 * tick), (0.0, 0.4), (hand_n, 0.0), leads=True)
    return drifted, watch.state.released


def phase(phases: StatePhases, tick: int) -> Any:
    arrived = [tick * TICK_NS + 1_700_000 * (module == 1) for module in range(N_MODULES)]
    phases.advance([STATE] * N_MODULES, arrived, arrived[0] - 1)
    return phases.state.phases, list(phases.state.sums)


def loaded(kg: float) -> Part:
    return Part(
        lambda _: Load((8.0, 20.0), 700.0, 40.0, 0.5), lambda one, n: weigh(one, n, kg), 400
    )


PARTS = {
    "coupling": Part(lambda robot: CoupledTorque(3.0, PushIntegral(robot.law)), couple),
    "levelling": Part(lambda _: Levelling(1.0), level),
    "a load of 9 kg": loaded(9.0),
    "3 kg less": loaded(-3.0),
    "phases": Part(lambda _: StatePhases(500.0, 250.0), phase, 120),
    "shift": Part(lambda _: ShiftReference((0.03, 0.04, 0.06, 0.12)), shift),
    "trips": Part(PlannerTrips, trip, 24),
    "unattended": Part(lambda _: Unattended(), drift),
}


def state_of(part: Any) -> Any:
    """Return the state of a part; one that computes in arrays makes it of them."""
    return part.snapshot() if hasattr(part, "snapshot") else part.state


def go_on(part: Any, state: Any) -> None:
    if hasattr(part, "restore"):
        part.restore(state)
    else:
        part.state = state


def copied(memory: Any) -> Any:
    """Return a state as it comes back from a log."""
    if isinstance(memory, msgspec.Struct):
        return msgspec.json.decode(msgspec.json.encode(memory), type=type(memory))
    return memory


@pytest.mark.parametrize("name", PARTS)
def test_a_part_goes_on_from_its_state_bit_for_bit(robot: RobotConfig, name: str) -> None:
    part = PARTS[name]
    one = part.make(robot)
    course = [part.tick(one, tick) for tick in range(part.ticks)]
    assert course[-1] != course[part.ticks // 2], "there is a state to forget"
    for begin in (1, part.ticks // 4, part.ticks // 2):
        first, other = part.make(robot), part.make(robot)
        for tick in range(begin):
            part.tick(first, tick)
        go_on(other, copied(state_of(first)))
        assert [part.tick(other, tick) for tick in range(begin, part.ticks)] == course[begin:]
        assert state_of(other) == state_of(one)


def astray(q: Array) -> Array:
    return q + 1e-2 * np.random.default_rng(4).normal(size=12)


COURSES: dict[str, dict[str, Any]] = {
    "a module that stays disarmed": {"mode": int(Mode.DISARMED), "drive": int(DriveStatus.IDLE)},
    "another planner that leads": {"session": 99},
    "feet astray": {},
}


@pytest.mark.parametrize("name", COURSES)
def test_a_planner_goes_on_bit_for_bit(robot: RobotConfig, closed: Closed, name: str) -> None:
    """It goes on counting, with the wish, the stance and the rival that it had."""
    changes, q = COURSES[name], closed(1.188, x=0.01, pitch=0.1)
    q = astray(q) if name == "feet astray" else q
    planner, twin = Planner(robot, SESSION), Planner(robot, SESSION)
    planner.receive_request(OperatorRequest(0.0, (0.01, 0.0, 0.0, 0.02)))
    seen = []
    for tick in range(60):
        if tick == 40:
            text = msgspec.json.encode(planner.snapshot())
            twin.restore(msgspec.json.decode(text, type=PlannerState))
        now_ns = START_NS + tick * TICK_NS
        both = []
        for each in (planner, twin) if tick >= 40 else (planner,):
            receive_all(each, q, now_ns, seq=tick, **changes)
            both.append((each.tick(now_ns), each.status(now_ns, 0.0)))
        assert both[0] == both[-1]
        seen.append(both[0])
    status = seen[-1][1]
    assert status.shift_requested == (0.01, 0.0, 0.0, 0.02)
    if name == "a module that stays disarmed":
        assert [seen[40][0][0].stiffen, seen[-1][0][0].stiffen] == [False, True]
    elif name == "another planner that leads":
        assert "99" in status.why
    else:
        assert math.hypot(*status.stance[:3]) > 1e-3
