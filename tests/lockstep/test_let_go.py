"""Nobody's hand on it, and a load that the robot file does not know: it stays where it was.

Led on, it went to straight legs (payload -15 %), to the knees' stop with the torso over by 2.3 rad
(+20 %), and fell (COM 5 cm back and 10 cm up).
"""

from __future__ import annotations

import math
from typing import Any

import pytest

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import PlannerMode, PlannerStatus, Trip
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe
from tests.lockstep.runs import variant
from tools.sim.lockstep import Lockstep
from tools.sim.standing_start import begin_standing

LET_GO_S = 3.0


REFUSED_ROWS = 600
"""Of the simulated world, which is seen at 100 Hz: 6 s."""


def run(
    robot: RobotConfig, errors: dict[str, Any], height: float = 1.1, let_go_s: float = LET_GO_S
) -> tuple[Lockstep, list[tuple[float, float, float]]]:
    """Return the fleet after 8 s, and (time, torso's height, pitch) from letting go on."""
    frames = (Keyframe(at=0.0, height=1.188), Keyframe(at=2.0, height=height))
    scenario = variant("stand", duration=8.0, keyframe=frames, kill=(), push=())
    plant = changed(PlantConfig(), errors)
    fleet = Lockstep(robot, scenario, Impairment(delay_ms=1.0), plant=plant)
    assert begin_standing(fleet)
    poses = []
    for row in fleet.run():
        assert not row.fallen
        if row.scenario_s >= let_go_s:
            fleet.world.let_go()
            poses.append((row.scenario_s, row.torso[2], row.angles[1]))
    return fleet, poses


def status_of(fleet: Lockstep) -> PlannerStatus:
    assert fleet.planner is not None
    return fleet.planner.status(fleet.now_ns, 0.0)


def not_led(robot: RobotConfig, errors: dict[str, Any]) -> tuple[Lockstep, list[float]]:
    """Return the fleet after it was refused for so long, and the torso's heights until then."""
    fleet = Lockstep(robot, variant("stand"), plant=changed(PlantConfig(), errors))
    heights, refused = [], 0
    for row in fleet.run():
        assert not row.fallen
        assert row.scenario_s < 0.0, "the scenario waits for six that track"
        heights.append(row.torso[2])
        refused += status_of(fleet).mode == PlannerMode.MISLOADED
        if refused == REFUSED_ROWS:
            return fleet, heights
    raise AssertionError(status_of(fleet))


@pytest.mark.sampled(4)
@pytest.mark.parametrize(
    ("errors", "kg"),
    [
        ({"body.payload_scale": 0.85}, -3.06),
        ({"body.payload_scale": 1.2}, 4.08),
        ({"body.com_offset": [0.03, 0.0, 0.0]}, 0.0),
    ],
)
@pytest.mark.parametrize("height", [1.1, 0.9])
def test_let_go_of_it_stays(
    robot: RobotConfig, height: float, errors: dict[str, Any], kg: float
) -> None:
    fleet, poses = run(robot, errors, height)
    heights, pitches = [z for _, z, _ in poses], [pitch for _, _, pitch in poses]
    assert max(heights) - min(heights) < 0.12
    assert max(map(abs, pitches)) < 1.1
    status = status_of(fleet)
    assert status.trip == Trip.UNATTENDED
    assert status.load[0] == pytest.approx(kg, abs=0.7)


def test_a_load_too_far_back_is_not_led(robot: RobotConfig) -> None:
    fleet, _ = not_led(robot, {"body.com_offset": [-0.05, 0.0, 0.1]})
    assert "lies too far behind" in status_of(fleet).why


@pytest.mark.parametrize("scale", [0.0, 0.3])
def test_without_its_payload_it_holds_as_the_hoist_lets_go(
    robot: RobotConfig, scale: float
) -> None:
    """Led on the hoist, it rose by 0.1 m to straight legs, where torques tell nothing."""
    fleet, heights = not_led(robot, {"body.payload_scale": scale})
    assert max(heights) - min(heights) < 0.01
    assert "kg less than its file says" in status_of(fleet).why


def test_with_nothing_amiss_it_is_led_on_and_stays_too(robot: RobotConfig) -> None:
    fleet, poses = run(robot, {})
    assert max(z for _, z, _ in poses) - min(z for _, z, _ in poses) < 0.01
    assert status_of(fleet).mode == PlannerMode.LEADING


@pytest.mark.parametrize("scale", [0.5, 1.5])
def test_half_a_payload_too_much_or_too_little_is_not_led(robot: RobotConfig, scale: float) -> None:
    """It went to straight legs, or to the knees' stop, at 0.4 m/s."""
    fleet, _ = not_led(robot, {"body.payload_scale": scale})
    status = status_of(fleet)
    assert status.load[0] == pytest.approx((scale - 1.0) * robot.mass.payload, abs=1.0)
    assert f"kg {'more' if scale > 1.0 else 'less'} than its file says" in status.why


def test_a_hand_that_comes_back_leads_again(robot: RobotConfig) -> None:
    fleet, _ = run(robot, {"body.payload_scale": 1.2}, let_go_s=math.inf)
    assert status_of(fleet).mode == PlannerMode.LEADING
