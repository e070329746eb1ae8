"""The shipped planner is believed, whatever happens, and nothing trips but on a hard shove.

So it is in the squat and the crawl (`test_squat.py`), and at the corners of leans and stances
(`test_stance.py`).
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest

from services.joint.envelope import Envelope
from services.joint.failsafe import Failsafe
from services.planner.watch.trips import PlannerTrips, TripsState
from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import Cause, Mode, Outside, PlannerMode, Trip
from shared.bus.traces import SimTruth
from shared.config.impairment import Impairment
from shared.config.scenarios import Inject, Push, Scenario
from shared.robot.trip_table import JOINT_TRIPS
from tests.lockstep.runs import Run, kill, led_to, push, restart, run, variant
from tests.robots import ROBOT
from tools.lab.studies.sweeps import plants
from tools.lab.studies.sweeps.plants import PushRange
from tools.sim.lockstep import Lockstep
from tools.sim.network import BASE

LOW = (1.5, 0.95)


class Judged:
    """What the six envelopes said while a planner was tracked.

    Of commands that lead: one that holds, after a drop-out, may step once by the coupled torque
    that it drops. It is refused for 4 ms, and the next one is accepted.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.leading, self.outside = 0, Counter[str]()
        self.tripped: list[str] = []
        advance, seen = PlannerTrips.advance, Failsafe.advance
        judge = Envelope.judge

        def listening(own: Envelope, command, last, *rest, **more):  # type: ignore[no-untyped-def]
            found = judge(own, command, last, *rest, **more)
            self.leading += not command.hold
            if found is not Outside.NOTHING and not command.hold:
                self.outside[found.name] += 1
            return found

        def watching(own: PlannerTrips, state: TripsState, *rest: Any, **more: Any) -> None:
            advance(own, state, *rest, **more)
            if state.tripped and state.tripped not in (Trip.EDGE, Trip.TIPPING):
                self.tripped.append(state.why)

        def hearing(own: Failsafe, *rest: Any, **more: Any) -> Cause | None:
            cause = seen(own, *rest, **more)
            if cause in JOINT_TRIPS:
                self.tripped.append(cause.name)
            return cause

        monkeypatch.setattr(Envelope, "judge", listening)
        monkeypatch.setattr(PlannerTrips, "advance", watching)
        monkeypatch.setattr(Failsafe, "advance", hearing)


@pytest.fixture
def judged(monkeypatch: pytest.MonkeyPatch) -> Judged:
    return Judged(monkeypatch)


def led(
    judged: Judged, scenario: Scenario, network: Impairment = BASE,
    plant: PlantConfig | None = None, **how: Any,
) -> Run:  # fmt: skip
    """Run; assert that it never falls and that everything is believed."""
    outcome = run(ROBOT, scenario, network=network, plant=plant, **how)
    assert not outcome.rows[-1].fallen
    assert judged.leading > 500, "there was something to believe"
    assert judged.outside == {}
    assert judged.tripped == []
    return outcome


def test_while_a_strong_hand_leads_up_within_a_second(judged: Judged) -> None:
    low = 1.188 - 0.45
    outcome = led(judged, led_to((2.5, low), (3.0, low), (3.7, 1.188), duration=5.0))
    assert outcome.rising > 1.0, "it is led fast"


def test_a_killed_planners_successor_takes_over_without_a_step(judged: Judged) -> None:
    restarted = {"kill": kill(2.2), "restart": restart(2.8), "push": ()}
    outcome = led(judged, variant("squat", duration=5.0, **restarted))
    assert outcome.status.mode == PlannerMode.LEADING
    assert set(outcome.modes) == {Mode.TRACK}
    assert all(each.failsafe.dropouts.count == 1 for each in outcome.lockstep.controllers)
    assert max(outcome.steps_nm()) <= 5.0


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "network",
    [
        Impairment(delay_ms=10.0, jitter_ms=5.0, loss=0.3),
        Impairment(delay_ms=5.0, loss=0.5),
        Impairment(delay_ms=15.0, jitter_ms=8.0),
    ],
    ids=lambda network: f"{network.delay_ms:g}-{network.jitter_ms:g}-{network.loss:g}",
)
def test_over_a_bad_network(judged: Judged, network: Impairment) -> None:
    scenario = led_to(LOW, duration=40.0, push=(push(1.0, 0.0, 40.0, 0.0),))

    def enough(_fleet: Lockstep, row: SimTruth) -> bool:
        return row.scenario_s > 4.0 and judged.leading > 600

    led(judged, scenario, network, each=enough)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("number", range(4))
def test_on_drawn_plants_pushed_hard(judged: Judged, number: int) -> None:
    angle = (0.0, math.pi, math.pi / 2, -2.0)[number]
    hard = (PushRange(ROBOT).push(2.0, 0.3, 0.75, angle),)
    scenario = led_to(LOW, duration=4.5, push=hard)
    led(judged, scenario, Impairment(delay_ms=5.0), plants.draw(f"right planner {number}"))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("direction", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)])
def test_held_off_centre_it_is_believed_and_leads_again(
    judged: Judged, direction: tuple[float, float]
) -> None:
    """Cut off as a push has moved it, it holds there; led again it begins from the middle."""
    x, y = (50.0 * part for part in direction)
    pushed = (Push(at=0.5, duration=0.4, force=(x, y, 0.0)),)
    cut = (Inject(link="planner->joints", at=0.8, partition=True, duration=1.0),)
    outcome = led(judged, variant("stand", duration=5.5, push=pushed, inject=cut))
    away_mm = np.hypot(outcome.com_mm[:, 0], outcome.com_mm[:, 1])
    held = (outcome.t > 0.85) & (outcome.t < 1.8)
    assert away_mm[held].max() > 20.0, "it was off centre"
    assert outcome.status.mode == PlannerMode.LEADING
    assert away_mm[-1] < 10.0
