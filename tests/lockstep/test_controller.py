"""A controller of somebody's own in the planner's place: it may be wrong, and the robot stands."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.planner.controller import Action, Observation, controller_maker
from services.planner.law.hocca import LawOutput
from services.simulator.physics.plant import PlantConfig, changed
from shared.bus import topics
from shared.bus.messages import Message, Mode
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from tests.imu.robots import with_imu
from tests.lockstep.runs import Run, kill, modes_of, push, run, standing_as, still
from tests.planner.states import with_law
from tests.robots import ROBOT
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import Lockstep

LQR = Path(__file__).parents[2] / "examples" / "lqr_controller.py"

BEGINS_S = 0.3


class Own:
    """Changes the shipped law's action once `BEGINS_S` have passed."""

    def __init__(self, change: Callable[[Observation, Action], Action]) -> None:
        self._change = change

    def reset(self, seen: Observation) -> None:
        """Nothing."""

    def step(self, seen: Observation) -> Action:
        action = Action.from_law(seen.law)
        return self._change(seen, action) if seen.time_s > BEGINS_S else action


CHANGES: dict[str, Callable[[Observation, Action], Action]] = {
    "half the gains": lambda _, action: action._replace(D=0.5 * action.D),
    "no gains": lambda _, action: action._replace(D=np.zeros(12)),
    "weight upside down": lambda _, action: action._replace(tau_ff=-action.tau_ff),
    "no weight": lambda _, action: action._replace(tau_ff=np.zeros(12)),
    "full torque": lambda _, action: action._replace(tau_coupled=np.full(12, 150.0)),
    "references a radian off": lambda _, action: action._replace(q_ref=action.q_ref + 1.0),
    "runaway references": lambda seen, action: action._replace(
        q_ref=action.q_ref + 0.3 * (seen.time_s - BEGINS_S), v_ref=action.v_ref + 0.3
    ),
    "torque to and fro": lambda seen, action: action._replace(
        tau_coupled=np.full(12, 60.0 * math.sin(60.0 * seen.time_s))
    ),
    "leans sideways slowly": lambda seen, action: action._replace(
        q_ref=action.q_ref + 0.05 * (seen.time_s - BEGINS_S) * seen.T[:, 1]
    ),
    "leans forward slowly": lambda seen, action: action._replace(
        q_ref=action.q_ref + 0.05 * (seen.time_s - BEGINS_S) * seen.T[:, 0]
    ),
    "turns": lambda seen, action: action._replace(
        q_ref=action.q_ref + 0.3 * (seen.time_s - BEGINS_S) * seen.T[:, 5]
    ),
    "leans as fast as it may": lambda seen, action: action._replace(
        q_ref=action.q_ref + 0.3 * min(0.4, seen.time_s - BEGINS_S) * seen.T[:, 0],
        v_ref=action.v_ref + 0.3 * seen.T[:, 0],
    ),
}


def fleet_of(
    duration: float, change: Callable[[Observation, Action], Action] | None,
    robot: RobotConfig = ROBOT, **how: Any,
) -> Run:  # fmt: skip
    """Run with a controller of one's own that changes the shipped law's action, or with none."""
    controller = None if change is None else lambda: Own(change)
    return run(robot, still(duration), controller=controller, **how)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", CHANGES)
def test_whatever_it_does_the_robot_stands(name: str) -> None:
    outcome = fleet_of(3.5, CHANGES[name])
    assert outcome.stood
    assert abs(outcome.rows[-1].over[0]) < 0.08


def test_one_that_changes_nothing_is_the_shipped_law_to_the_last_bit() -> None:
    start = standing_as(ROBOT)
    robot = with_law(ROBOT, push_integral_max=0.0)  # the integral would wind up against another law
    mine, shipped = (
        fleet_of(0.8, change, robot, start=start) for change in (lambda _, action: action, None)
    )
    assert mine.com_mm.tolist() == shipped.com_mm.tolist()


@pytest.mark.sampled(3)
@pytest.mark.parametrize("number", range(3))
def test_the_examples_lqr_stands_through_pushes_and_kill(number: int) -> None:
    plant = plants.draw(f"lqr {number}") if number else PlantConfig()
    pushes = (push(0.5, 30.0, 0.0, 0.0), push(2.5, 30.0, 0.0, 0.0))
    tracked: list[bool] = []

    def look(fleet: Lockstep, row: SimTruth) -> None:
        tracked.append(row.scenario_s < 1.5 and set(modes_of(fleet)) == {Mode.TRACK})

    scenario, lqr = still(4.0, push=pushes, kill=kill(1.5)), controller_maker(str(LQR), ROBOT)
    assert run(ROBOT, scenario, plant=plant, controller=lqr, each=look).stood
    assert sum(tracked) > 140 or number, "on the realistic plant it leads until it is killed"


def test_its_output_is_what_is_sent() -> None:
    """Not the shipped law's beside it."""
    outputs: list[LawOutput] = []

    def push_forward(seen: Observation, action: Action) -> Action:
        outputs.append(seen.law)
        return action._replace(tau_coupled=action.tau_coupled + 0.25)

    sent: list[tuple[float, float]] = []

    def record(topic: Topic, module: str, message: Message) -> None:
        if topic is topics.JOINT_COMMAND and module == "knee_left":
            sent.append(message.tau_coupled)  # type: ignore[attr-defined]  # a command

    fleet_of(0.6, push_forward, record=record)
    assert sent[-1][0] == pytest.approx(outputs[-1].tau_coupled[8] + 0.25, abs=6e-4)


def test_on_a_slope_it_is_followed_as_on_the_level() -> None:
    """Where the COM is uphill of the ankles it is over them."""
    plant = changed(PlantConfig(), {"floor.slope": [0.06, 0.0]})
    lqr = controller_maker(str(LQR), ROBOT)
    outcome = run(with_imu(ROBOT), still(2.0), plant=plant, controller=lqr)
    assert outcome.stood
    assert set(outcome.modes) == {Mode.TRACK}
    assert abs(outcome.rows[-1].com[0]) > 0.03, "it stands uphill of its ankles"
