"""`xrl down` in virtual time: the way down, and what bears the robot when its drives go limp."""

from __future__ import annotations

import functools
import re
from typing import Any

import msgspec
import numpy as np
import pytest

from services.planner.intents import OperatorRequest
from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import JointState, Message, Mode, PlannerStatus
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.exceptions import FleetError
from shared.joints import MODULE_INDEX, MODULES
from tests.lockstep.runs import Run, kill, led_to, modes_of, push, run, still
from tests.planner.states import with_law
from tests.robots import ROBOT
from tools.lab.studies.sweeps import plants
from tools.live.descent import LIGHT_FRACTION, Ask, Descent, DescentPhase
from tools.sim.lockstep import Lockstep

AT_S = 0.3
HEARD_S = 0.1


class Descending(Lockstep):
    """A fleet in which `xrl down` was typed at `AT_S`.

    Attributes:
        error: what it gave up with.
        asks: what it asked for, in order.
        interrupt: Ctrl-C at a scenario's time.
    """

    def __init__(self, robot: RobotConfig, *args: Any, wait_s: float, **how: Any) -> None:
        self.descent = Descent(robot, wait_s=wait_s)
        self.states: list[JointState | None] = [None] * len(MODULES)
        self.status: PlannerStatus | None = None
        self.asks: list[Ask] = []
        self.error = ""
        self.interrupt_s = np.inf
        super().__init__(robot, *args, record=self.hear, **how)

    def hear(self, _topic: Topic, module: str, message: Message) -> None:
        if isinstance(message, JointState):
            self.states[MODULE_INDEX[module]] = message
        elif isinstance(message, PlannerStatus):
            self.status = message

    def _request(self) -> OperatorRequest:
        sits = bool(self.asks) and self.asks[-1] is Ask.SIT and not self.error
        sits &= self.world.scenario_s < self.interrupt_s
        return super()._request()._replace(sit=sits)

    def look(self) -> Ask:
        """Look once, as the verb does."""
        now_s = 1e-9 * self.now_ns

        def fresh(message: Any) -> Any:
            old = message is None or now_s - 1e-9 * message.t_ns > HEARD_S
            return None if old else message

        try:
            ask = self.descent.step(now_s, [fresh(s) for s in self.states], fresh(self.status))
        except FleetError as error:
            self.error, ask = str(error), Ask.NOTHING
        if not self.asks or ask is not self.asks[-1]:
            self.asks.append(ask)
        self.estop |= ask is Ask.STOP
        return ask


def go_down(
    robot: RobotConfig,
    scenario: Scenario,
    plant: PlantConfig | None = None,
    each: Any = lambda _fleet, _row: None,
    interrupt_s: float = np.inf,
    wait_s: float = 5.0,
) -> Run:
    """Type `xrl down` at `AT_S`; go on for half a second after its end."""
    ended: list[float] = []

    def look(fleet: Descending, row: SimTruth) -> bool:
        fleet.interrupt_s = interrupt_s
        if row.scenario_s < AT_S:
            return False
        each(fleet, row)
        if not ended and (fleet.error or fleet.look() is Ask.IDLE):
            ended.append(row.scenario_s)
        return bool(ended) and row.scenario_s > ended[0] + 0.5

    how = {"fleet_type": functools.partial(Descending, wait_s=wait_s), "each": look}
    outcome = run(robot, scenario, plant=plant, **how)
    assert not outcome.rows[-1].fallen
    on_feet = [row for row in outcome.rows if row.hoist == 0.0]
    assert max(max(row.foot_left_tilt, row.foot_right_tilt) for row in on_feet) < 0.05
    return outcome


def alone(duration: float = 40.0, **changes: Any) -> Scenario:
    return msgspec.structs.replace(still(duration, **changes), hand=False)


def floor_speed(fleet: Lockstep) -> float:
    """Idle the drives, and return how fast the torso comes to the floor, m/s."""
    heights: list[float] = []
    for row in fleet.run():
        heights.append(row.torso[2])
        for joint in fleet.joints:
            joint.frozen = True
            joint.drive.idle()
        if heights[-1] < 0.2:
            break
    assert heights[-1] < 0.2
    return float(-np.gradient(heights, 0.01).min())


HOISTED_M = 1.45
HOIST_M = 0.003
"""In 10 ms."""


def hang(fleet: Descending, row: SimTruth) -> None:
    """Once it is down, have a hoist lift it until its feet are in the air."""
    hoist = fleet.world.outside.hoist
    if fleet.descent.phase is DescentPhase.RESTING and hoist.share == 0.0:
        hoist.position = np.array(row.torso)
        hoist.share, hoist.releasing = 1.0, False
    elif hoist.share > 0.0:
        hoist.position[2] = min(HOISTED_M, hoist.position[2] + HOIST_M)


@pytest.mark.sampled(20)
@pytest.mark.parametrize("number", range(20))
def test_it_goes_down_and_holds_until_a_hoist_bears_it(number: int) -> None:
    found = go_down(ROBOT, alone(), plants.draw(f"down {number}"), hang)
    assert found.lockstep.asks[-1] is Ask.IDLE
    assert found.rows[-1].hoist == 1.0, "not before"
    assert found.sinking < 0.2
    assert found.height.min() < 0.85, "the lowest pose"


def test_with_nothing_to_bear_it_it_holds_and_says_what_helps() -> None:
    """Idled there it tips: the torso meets the floor at 2.8 m/s, as from a stand."""
    found = go_down(ROBOT, alone(), wait_s=1.0)
    assert found.sinking < 0.2
    assert re.search("still carry the robot: the legs carry [89]. %", found.lockstep.error)
    assert "stand under its torso" in found.lockstep.error
    assert Ask.IDLE not in found.lockstep.asks
    assert found.height[-1] < 0.85
    assert {*modes_of(found.lockstep)} == {Mode.DAMP}
    assert 2.3 < floor_speed(found.lockstep) < 3.5


def test_a_robot_without_its_payload_is_not_taken_for_a_hanging_one() -> None:
    led = with_law(ROBOT, load_correction=(0.0, 0.0))  # whatever it carries
    light = changed(PlantConfig(), {"body.payload_scale": 0.0})
    found = go_down(led, alone(kill=kill(0.1)), light, wait_s=1.0)
    assert "still carry the robot: the legs carry" in found.lockstep.error
    assert found.lockstep.asks == [Ask.NOTHING, Ask.STOP, Ask.NOTHING]
    assert LIGHT_FRACTION < 0.5, "what it still bears"


def test_a_planner_that_dies_on_the_way_does_not_keep_it_up() -> None:
    found = go_down(ROBOT, alone(kill=kill(2.8)), each=hang)
    assert Ask.SIT in found.lockstep.asks
    assert found.lockstep.asks[-3:] == [Ask.STOP, Ask.NOTHING, Ask.IDLE], "it sinks in DAMP"
    assert found.sinking < 0.2


@pytest.mark.sampled(2)
@pytest.mark.parametrize("at", [1.8, 3.8])
def test_interrupted_it_stands_where_it_is(at: float) -> None:
    heights = []

    def stop(fleet: Descending, row: SimTruth) -> None:
        if row.scenario_s > at:
            fleet.error = fleet.error or "interrupted"
            heights.append(row.torso[2])

    found = go_down(ROBOT, alone(), each=stop, interrupt_s=at)
    assert heights[0] - found.height[-1] < 0.05
    assert found.height[-1] > 0.9
    assert not {*modes_of(found.lockstep)} - {Mode.TRACK, Mode.HOLD}


def test_a_hand_that_holds_it_up_is_not_pressed_down() -> None:
    found = go_down(ROBOT, still(40.0))
    assert "held up" in found.lockstep.error
    assert max(abs(row.operator_force[2]) for row in found.rows) < 95.0
    assert found.height[-1] > 1.05


def test_a_person_who_goes_along_takes_it_down() -> None:
    scenario = led_to((AT_S, 1.188), (AT_S + 6.0, 0.83), duration=40.0)
    found = go_down(ROBOT, scenario, each=hang)
    assert found.lockstep.asks[-1] is Ask.IDLE


@pytest.mark.sampled(8)
@pytest.mark.parametrize("number", range(8))
def test_pushed_on_its_way_it_does_not_tip(number: int) -> None:
    pushes = (push(2.3, 30.0, 0.0, 0.0), push(3.3, 0.0, 30.0, 0.0), push(4.8, -30.0, 0.0, 0.0))
    found = go_down(ROBOT, alone(push=pushes), plants.draw(f"pushed {number}"), hang)
    assert found.lockstep.asks[-1] is Ask.IDLE
