"""What the planner does before a motor is too warm."""

from __future__ import annotations

import numpy as np
import pytest

from services.planner.law.height import Toward
from services.planner.watch.heat import (
    EASE_S,
    HAND_MAX,
    REST_S,
    RESTED_ON,
    SHED_RATE,
    HeatDecision,
    HeatWatch,
    HeatWatchState,
)
from shared.bus.messages import HeatAction
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, N_MODULES
from tests.planner.states import Kept, state

NONE, EASES, STANDS_UP, RESTS = HeatAction
SQUATTED, STRAIGHT = -1.2, -0.3


class Watched:
    """A watch over six modules, in ticks of 0.1 s."""

    def __init__(self, robot: RobotConfig) -> None:
        self.watch = Kept(HeatWatch(robot.heat), HeatWatchState())
        self.now_s = 100.0

    def run(
        self, left_s: float, knee: float = SQUATTED, *, seconds: float = 0.1,
        requested: float = 0.0, lifted: float | None = 0.0, module: int = 1,
    ) -> HeatDecision:  # fmt: skip
        q = np.tile((0.0, knee), N_MODULES)
        states = [
            state(i, q, heat_left_s=left_s if i == module else 3600.0) for i in range(N_MODULES)
        ]
        for _ in range(max(1, round(10.0 * seconds))):
            now_ns = round(self.now_s * NS_PER_S)
            self.watch.state.lifted = lifted
            decision = self.watch.advance(now_ns, states, requested, 0.1)
            self.now_s += 0.1
        return decision

    @property
    def action(self) -> HeatAction:
        return self.watch.state.action


@pytest.mark.parametrize("module", range(N_MODULES))
def test_each_module_is_watched_and_named(robot: RobotConfig, module: int) -> None:
    watched = Watched(robot)
    watched.run(robot.heat.stand_s - 1.0, module=module)
    assert watched.action is STANDS_UP
    assert watched.watch.describe().startswith(MODULES[module])


def test_every_action_follows_at_its_limit_and_no_sooner(robot: RobotConfig) -> None:
    watched, heat = Watched(robot), robot.heat
    for left_s, knee, action in (
        (-1.0, SQUATTED, NONE),  # not estimated
        (3600.0, SQUATTED, NONE),
        (heat.ease_s, SQUATTED, NONE),
        (heat.ease_s - 0.1, SQUATTED, EASES),
        (10.0 * heat.ease_s - 0.1, SQUATTED, EASES),
        (10.0 * heat.ease_s, SQUATTED, NONE),
        (heat.stand_s, SQUATTED, EASES),
        (heat.stand_s - 0.1, SQUATTED, STANDS_UP),
        (3600.0, SQUATTED, STANDS_UP),  # nothing ends it half way
        (3600.0, STRAIGHT, RESTS),
        (3600.0, STRAIGHT - 0.2, RESTS),
        (3600.0, SQUATTED, STANDS_UP),  # pressed down again
    ):
        watched.run(left_s, knee)
        assert watched.action is action, (left_s, knee)


def test_it_rests_for_a_while_and_until_enough_is_left(robot: RobotConfig) -> None:
    watched = Watched(robot)
    watched.run(1.0)
    watched.run(3600.0, STRAIGHT, seconds=REST_S - 1.0)
    assert watched.action is RESTS
    assert watched.run(1.5 * robot.heat.ease_s, STRAIGHT, seconds=2.0).toward is Toward.REST
    for lifted in (-HAND_MAX - 1.0, HAND_MAX + 1.0, None):
        assert watched.run(3600.0, STRAIGHT, seconds=1.0, lifted=lifted).toward is Toward.REST
    assert watched.run(3600.0, STRAIGHT, seconds=1.0).toward is Toward.PERSON
    assert watched.action is NONE


def test_straight_and_still_too_hot_it_says_what_a_person_must_do(robot: RobotConfig) -> None:
    watched = Watched(robot)
    watched.run(1.0)
    watched.run(3600.0, STRAIGHT, module=4)
    assert watched.watch.describe().startswith(f"{MODULES[1]} was hot")
    watched.run(robot.heat.ease_s - 1.0, STRAIGHT, module=4)
    assert "left even straight" in watched.watch.describe()
    assert watched.watch.describe().startswith(MODULES[4])


def test_the_assist_goes_but_never_from_under_the_person(robot: RobotConfig) -> None:
    free, resting = Watched(robot), Watched(robot)
    left_s = robot.heat.ease_s - 5.0
    assert free.run(left_s, requested=200.0).assist == pytest.approx(200.0 - 20.0 * 0.1)
    free.run(left_s, requested=200.0, seconds=EASE_S)
    assert free.run(left_s, requested=200.0).assist == pytest.approx(0.0)
    resting.run(left_s, requested=200.0, lifted=-150.0, seconds=EASE_S)
    decision = resting.run(left_s, requested=200.0, lifted=-150.0)
    assert decision.assist == pytest.approx(150.0 - RESTED_ON)
    assert resting.run(left_s, requested=100.0, lifted=-150.0).assist <= 100.0
    decision = resting.run(left_s, requested=200.0, lifted=0.0, seconds=10.0)
    assert decision.assist == pytest.approx(150.0 - RESTED_ON - 10.0 * SHED_RATE)
