"""How hard a push a stand bears: against MuJoCo at rest, and against what no gains can beat."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.law.split import ScheduledGains
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import NAMED, changed
from services.simulator.physics.world import World
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Push, Scenario
from shared.joints import MODULES, N_JOINTS, N_LEG
from tools.lab.design.poses import Poses
from tools.lab.design.push_limit import DIRECTIONS, RIGID, LoadedStand, stand_at
from tools.lab.studies.sweeps.plants import torso_at

HEIGHTS = (0.7, 0.8, 0.9)
STIFF = np.tile([900.0, 1500.0, 900.0, 1500.0, 900.0, 900.0], 2)
SOFT = np.tile([600.0, 1000.0, 50.0, 60.0, 50.0, 30.0], 2)
DAMPING = 60.0
PUSH_N = 15.0
FLOOR_S = 0.004
"""Contact time of a floor that hardly gives: the soles' own roll is not in the formula."""
SETTLE_S = 4.0
HAND_PITCH, HAND_DOWN = 60.0, 150.0
"""The most that the simulated person's hand does, N m and N."""


class Posed(NamedTuple):
    stand: LoadedStand
    q: Array
    tau: Array
    """Joint torques that carry the weight at rest (12,), N m."""


@pytest.fixture(scope="module")
def poses(robot: RobotConfig) -> dict[float, Posed]:
    at, found = Poses(robot), {}
    for z in HEIGHTS:
        stand = stand_at(robot, at, z, 0.0)
        assert stand is not None
        found[z] = Posed(stand, at.q, at.F_O @ at.kinematics.J)
    return found


def torques_at_rest(robot: RobotConfig, posed: Posed, force: Array) -> Array:
    """Return the torques (12,), N m, of springs at the joints that hold a pose under a push."""
    scenario = Scenario(
        name="push", about="", duration=60.0, hand=False,
        keyframe=(Keyframe(at=0.0, height=1.0),),
        push=(Push(at=0.0, duration=60.0, force=(float(force[0]), float(force[1]), 0.0)),),
    )  # fmt: skip
    body = body_of(robot, changed(NAMED["ideal"], {"floor.contact_time": FLOOR_S}))
    world = World(body, scenario)
    world.stand_at(posed.q)
    world.start()
    to_motor = np.linalg.inv(2.0 * np.pi * body.motor_from_joint.T)
    q_index, v_index = world.joints.q_index, world.joints.v_index
    begin_q = world.data.qpos[q_index].copy()
    tau = posed.tau
    for _ in range(round(SETTLE_S / world.timestep)):
        q, v = world.data.qpos[q_index], world.data.qvel[v_index]
        tau = posed.tau + STIFF * (begin_q - q) - DAMPING * v
        world.step(to_motor @ tau)
    assert np.abs(world.data.qvel).max() < 1e-3, "it rests"
    return np.asarray(tau, float)


@pytest.mark.parametrize("z", HEIGHTS)
@pytest.mark.parametrize("name", DIRECTIONS)
def test_the_joints_carry_a_push_as_in_the_simulated_world(
    robot: RobotConfig, poses: dict[float, Posed], z: float, name: str
) -> None:
    posed, direction = poses[z], DIRECTIONS[name]
    response = posed.stand.response(STIFF, direction)
    assert response is not None
    unpushed, pushed = (
        torques_at_rest(robot, posed, force * np.array(direction)) for force in (0.0, PUSH_N)
    )
    dtau = pushed - unpushed
    assert dtau == pytest.approx(PUSH_N * response.dtau, abs=0.05 * np.abs(dtau).max() + 0.05)


@settings(max_examples=60)
@given(
    z=st.sampled_from(HEIGHTS),
    name=st.sampled_from(list(DIRECTIONS)),
    logs=st.lists(st.floats(1.5, 3.7), min_size=N_LEG, max_size=N_LEG),
)
def test_no_local_gains_hold_more_than_soles_and_motors_bear(
    poses: dict[float, Posed], z: float, name: str, logs: list[float]
) -> None:
    stand, direction = poses[z].stand, DIRECTIONS[name]
    D = np.tile(10.0 ** np.array(logs), 2)
    assert stand.limit_held(D, direction).force_n <= stand.limit_of_body(direction).force_n + 1e-6


def test_no_stiffness_along_y_bears_100_newtons_that_come_at_once(
    robot: RobotConfig, poses: dict[float, Posed]
) -> None:
    """They overshoot by 1.22 at least, upright. Nor do HOLD's gains; soles and motors would."""
    assert robot.gain_schedule is not None
    gains, K_c = ScheduledGains(robot.gain_schedule), np.diag([0.0, RIGID, 0.0, 800.0, 0.0, 400.0])
    hold = np.ravel([robot.hold_gains(module)[0] for module in MODULES])
    for z, (stand, *_) in poses.items():
        D, side = gains.at(z, 0.0), DIRECTIONS["sideways"]
        assert stand.limit_held(D, side, K_c).force_n < 122.0
        assert stand.limit_held(np.maximum(D, hold), side).force_n < 122.0
        assert stand.limit_of_body(side).force_n > 122.0


@pytest.mark.parametrize(
    ("limp", "down", "moment", "bears"),
    [
        ("", 0.0, HAND_PITCH, 1.549),
        ("ankle_left", 0.0, HAND_PITCH, 0.914),
        ("", HAND_DOWN, 0.0, 4.50),
        ("knee_left", HAND_DOWN, 0.0, 0.453),
    ],
)
def test_beside_a_limp_ankle_or_knee_no_control_bears_the_hands_most_on_the_way_into_the_crawl(
    robot: RobotConfig, limp: str, down: float, moment: float, bears: float
) -> None:
    """Two seconds on its way there the torso is at 1.05 m, turned by 0.41 rad."""
    pitch = 0.41
    stand, _ = torso_at(robot, 1.05, pitch)
    x, _, z = robot.geometry.harness_point
    arm = x * math.cos(pitch) + z * math.sin(pitch)
    wrench = (0.0, 0.0, -down, 0.0, moment + arm * down, 0.0)
    assert stand.limit_of_body(wrench, limp).force_n == pytest.approx(bears, rel=0.01)


def test_left_and_right_are_alike(poses: dict[float, Posed]) -> None:
    other = {"left": "right", "right": "left"}
    for posed in poses.values():
        left, right = (posed.stand.limit_held(STIFF, (0.0, side)) for side in (1.0, -1.0))
        assert left.force_n == pytest.approx(right.force_n, rel=1e-6)
        assert left.part == " ".join(other.get(word, word) for word in right.part.split())


def test_gains_that_do_not_stand_bear_no_push(poses: dict[float, Posed]) -> None:
    limit = poses[0.8].stand.limit_held(np.full(N_JOINTS, 1.0), (0.0, 1.0))
    assert limit == (0.0, "the stiffness")


def test_the_planner_adds_to_what_is_held(robot: RobotConfig, poses: dict[float, Posed]) -> None:
    K_c = np.diag([2000.0, 2000.0, 0.0, 500.0, 0.0, 500.0])
    for posed in poses.values():
        alone = posed.stand.limit_held(STIFF, (0.0, 1.0))
        led = posed.stand.limit_held(STIFF, (0.0, 1.0), K_c)
        assert led.force_n > alone.force_n


def test_an_integral_bears_its_part_of_a_push_from_the_side_as_the_body_shares_loads(
    poses: dict[float, Posed],
) -> None:
    K_c, rigid = np.diag([1600.0, 2000.0, 0.0, 500.0, 0.0, 250.0]), np.zeros((6, 6))
    rigid[1, 1] = RIGID
    side, ahead = DIRECTIONS["sideways"], DIRECTIONS["forwards"]
    for posed in poses.values():
        stand = posed.stand
        held = stand.limit_held(SOFT, side, K_c).force_n
        led = [stand.limit_led(SOFT, side, K_c, most).force_n for most in (0.0, 1.0, 20.0, 1e4)]
        assert led[0] == held < led[1] < led[2] < led[3]
        assert led[3] == stand.limit_held(SOFT, side, K_c + rigid).force_n
        assert stand.limit_led(SOFT, ahead, K_c, 60.0) == stand.limit_held(SOFT, ahead, K_c)
