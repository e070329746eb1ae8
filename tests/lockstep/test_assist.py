"""The harness in the loop, in virtual time."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from services.simulator.physics.body import body_of
from services.simulator.physics.plant import IDEAL
from services.simulator.physics.world import World
from shared.bus.messages import Cause, Mode, SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from tests.lockstep.runs import run, variant
from tools.sim.lockstep import Lockstep

RESTING = variant(
    "stand",
    duration=19.0,
    keyframe=(Keyframe(at=0.0, height=1.1), Keyframe(at=4.0, height=1.0, assist=200.0)),
)


def truths(robot: RobotConfig, scenario: Scenario, payload_error: float) -> list[SimTruth]:
    """Run with a payload that the planner does not know of, kg."""
    fleet = Lockstep(robot, scenario)
    mass = msgspec.structs.replace(robot.mass, payload=robot.mass.payload + payload_error)
    fleet.world = World(body_of(msgspec.structs.replace(robot, mass=mass), IDEAL), scenario)
    return [truth for truth in fleet.run() if truth.scenario_s >= 0.0]


def test_the_assist_comes_true_with_a_payload_the_planner_does_not_know(
    robot: RobotConfig,
) -> None:
    unweighed = msgspec.structs.replace(robot.law, load_correction=(0.0, 0.0))
    robot = msgspec.structs.replace(robot, law=unweighed)
    off = msgspec.structs.replace(robot.assist, integral_max=0.0)
    open_loop = msgspec.structs.replace(robot, assist=off)
    given = [
        np.mean([t.harness_force_z for t in truths(r, RESTING, -2.0) if t.scenario_s > 17.0])
        for r in (robot, open_loop)
    ]
    assert given[0] == pytest.approx(200.0, abs=10.0)
    assert abs(given[1] - 200.0) > 12.0


def test_with_the_load_found_it_comes_true_without_the_integral(robot: RobotConfig) -> None:
    off = msgspec.structs.replace(robot.assist, integral_max=0.0)
    with_mass = truths(msgspec.structs.replace(robot, assist=off), RESTING, -2.0)
    given = np.mean([t.harness_force_z for t in with_mass if t.scenario_s > 17.0])
    assert given == pytest.approx(200.0, abs=10.0)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("delay_ms", [1.0, 20.0])
def test_the_eased_lead_is_lighter_and_as_steady(robot: RobotConfig, delay_ms: float) -> None:
    plain_law, easy_law = (
        msgspec.structs.replace(robot, law=msgspec.structs.replace(robot.law, lead_easing=alpha))
        for alpha in (0.0, 0.5)
    )
    squat = variant("squat", duration=6.0, kill=(), push=())
    plain, eased = run(plain_law, squat, delay_ms), run(easy_law, squat, delay_ms)
    assert eased.stood
    assert np.abs(eased.operator_n).max() < 0.8 * np.abs(plain.operator_n).max()
    assert np.abs(eased.com_mm[:, 0]).max() < np.abs(plain.com_mm[:, 0]).max() + 1.0


def test_an_overloaded_harness_makes_all_six_hold_and_lets_them_lead_again(
    robot: RobotConfig,
) -> None:
    tight = msgspec.structs.replace(robot.harness, overload_force=170.0)
    frames = tuple(
        Keyframe(at=t, height=1.1, assist=a)
        for t, a in ((0.0, 0.0), (2.0, 190.0), (3.0, 190.0), (5.0, 0.0))
    )
    overloading = variant("stand", duration=9.0, keyframe=frames)
    fleet = Lockstep(msgspec.structs.replace(robot, harness=tight), overloading)
    held = False
    for truth in fleet.run():
        modes = {controller.failsafe.mode for controller in fleet.controllers}
        if 2.4 < truth.scenario_s < 3.3:
            assert modes == {Mode.HOLD}
            held = True
        assert not truth.fallen
    assert held
    assert modes == {Mode.TRACK}
    assert Cause.HOLD_ALL in {event.cause for _, event in fleet.events}
