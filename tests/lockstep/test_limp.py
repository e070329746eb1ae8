"""One module limp: the others stiffen and keep the robot up."""

from __future__ import annotations

import math
import random

import pytest

from shared.bus.messages import Mode
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Fault, FaultKind, Keyframe, Kill
from shared.joints import MODULE_INDEX, MODULES
from tests.lockstep.runs import Run, kill, push, run, variant
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import Lockstep

PUSHED_AFTER = 1.0
LASTING = 2.6
"""s from the fault on; unless the others stiffened a limp knee fell after 1.2 to 1.3 s."""


def limp(
    robot: RobotConfig,
    name: str,
    module: str,
    kind: FaultKind,
    at: float,
    *force: float,
    kill: tuple[Kill, ...] = (),
) -> Run:
    """Run a scenario to a fault and on, with a push a while after it."""
    scenario = variant(
        name,
        duration=at + LASTING,
        kill=kill,
        restart=(),
        fault=(Fault(module=module, kind=kind, at=at),),
        push=(push(at + PUSHED_AFTER, *force),),
    )
    return run(robot, scenario)


@pytest.mark.parametrize(("height", "pitch"), [(1.1, 0.5), (0.95, 0.9)])
def test_a_torso_that_a_hand_has_turned_stays_there_when_a_knee_goes_limp(
    robot: RobotConfig, height: float, pitch: float
) -> None:
    """Six such robots without a planner: pulled upright against the hand, two fell."""
    turned = (Keyframe(at=0.0, height=height), Keyframe(at=2.0, height=height, pitch=pitch))
    scenario = variant(
        "stand",
        duration=5.5,
        keyframe=turned,
        kill=kill(0.5),
        restart=(),
        fault=(Fault(module="knee_left", kind="disarmed", at=3.0),),
    )
    outcome = run(robot, scenario)
    assert outcome.stood
    before, after = (outcome.angles[outcome.t < 3.0][-1, 1], outcome.angles[-1, 1])
    assert abs(before) > 0.3
    assert after == pytest.approx(before, abs=0.15)


def stiffened(outcome: Run) -> list[str]:
    """Return the modules that hold with all they have."""
    states = [each.state(outcome.lockstep.now_ns) for each in outcome.lockstep.controllers]
    return [name for name, state in zip(MODULES, states, strict=True) if state.stiffened]


@pytest.mark.parametrize(
    ("name", "module", "kind", "at", "force"),
    [
        ("squat", "knee_left", "disarmed", 0.3, (30.0, 0.0, 0.0)),
        ("squat", "knee_right", "encoder", 1.5, (0.0, 30.0, 0.0)),
        ("squat", "knee_left", "over_voltage", 2.3, (-30.0, 0.0, 0.0)),
        ("crawl", "knee_right", "disarmed", 0.9, (0.0, 15.0, 0.0)),
    ],
)
def test_a_limp_knee_stands_on_five_that_brace_and_takes_a_push(
    robot: RobotConfig,
    name: str,
    module: str,
    kind: FaultKind,
    at: float,
    force: tuple[float, float, float],
) -> None:
    """The leg stands as a strut: on the hips' soft gains it folded at every phase of the squat."""
    outcome = limp(robot, name, module, kind, at, *force)
    assert outcome.stood
    after = outcome.t > at
    # in the crawl 15 N is near its limit: at 0.9 s a push of 20 N to the side ends in a fall
    assert abs(outcome.com_mm[after, :2]).max() < 60.0
    assert outcome.lockstep.controllers[MODULE_INDEX[module]].failsafe.mode is Mode.FAULT
    assert stiffened(outcome) == [other for other in MODULES if other != module]
    steps = [
        max(abs(b - a) for a, b in zip(event.tau_before, event.tau_after, strict=True))
        for other, event in outcome.lockstep.events
        if other != module and event.mode_after == Mode.HOLD
    ]
    assert max(steps) < 3.0, "nor does any of the five jerk"


@pytest.mark.parametrize(
    ("at", "force"),
    [(0.3, (0.0, 30.0, 0.0)), (1.5, (30.0, 0.0, 0.0)), (2.4, (0.0, -30.0, 0.0))],
)
def test_with_the_planner_dead_a_limp_knee_stands_as_well(
    robot: RobotConfig, at: float, force: tuple[float, float, float]
) -> None:
    """The services see it in each other's rows. Only a planner told them: 9 of 9 such runs fell."""
    planner_dead = kill(at - 0.2)
    outcome = limp(robot, "squat", "knee_left", "disarmed", at, *force, kill=planner_dead)
    assert outcome.stood
    assert stiffened(outcome) == [other for other in MODULES if other != "knee_left"]
    after = outcome.t > at
    assert abs(outcome.com_mm[after, :2]).max() < 75.0, "40 to 54 measured"


def test_for_a_limp_ankle_the_knees_alone_brace(robot: RobotConfig) -> None:
    """Stiff hips handed the hand's moment to the one ankle that is left: 4 of 4 fell."""
    outcome = limp(robot, "crawl", "ankle_left", "disarmed", 0.886, 0.001, 0.0, 0.0)
    assert outcome.stood
    assert stiffened(outcome) == ["knee_right", "knee_left"]
    assert abs(outcome.com_mm[:, 0]).max() < 120.0, "within the sole that is left"


@pytest.mark.sampled(3)
@pytest.mark.parametrize("number", range(8, 16))
def test_on_drawn_plants_a_limp_knee_stands_with_a_hand_and_without(
    robot: RobotConfig, number: int
) -> None:
    """Half of them with the planner dead, half let go. On the hips' stand gains 3 of 8 fell."""
    draw = random.Random(f"limp knee {number}")
    at, angle = draw.uniform(0.3, 3.0), draw.uniform(0.0, math.tau)
    pushed = push(at + 1.5, 30.0 * math.cos(angle), 30.0 * math.sin(angle), 0.0)
    knee = draw.choice(("knee_left", "knee_right"))
    scenario = variant(
        "squat",
        duration=at + 4.0,
        kill=kill(at - 0.1) if number % 2 else (),
        restart=(),
        fault=(Fault(module=knee, kind="disarmed", at=at),),
        push=(pushed,),
    )
    fleet = Lockstep(robot, scenario, plant=plants.draw(f"limp knee {number}"))
    for row in fleet.run():
        if number // 2 % 2 and row.scenario_s >= at + 0.2:
            fleet.world.let_go()
        assert not row.fallen
    assert row.scenario_s > at + 3.9
