"""The simulated world: how it starts, and what acts on it."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from services.simulator.physics.body import body_of
from services.simulator.physics.plant import IDEAL, PlantConfig, changed
from services.simulator.physics.world import World
from shared.arrays import Array
from shared.bus.traces import SimTruth
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.config.scenarios import Keyframe, Push, Scenario
from shared.joints import JOINTS, SIDES

IDLE = np.zeros(12)
STAND = Scenario(
    name="stand",
    about="nothing leads",
    duration=60.0,
    hand=False,
    keyframe=(Keyframe(at=0.0, height=1.188),),
)


def world_of(robot: RobotConfig, **changes: object) -> World:
    return World(body_of(robot, IDEAL), msgspec.structs.replace(STAND, **changes))


def seen(world: World) -> SimTruth:
    return world.truth(0, 1.0, 0.0)


def run(world: World, seconds: float) -> None:
    for _ in range(round(seconds / world.timestep)):
        world.step(IDLE)


def powers(world: World, torque: Array) -> tuple[float, float]:
    """Return power at the joints and at the motors, W, at the present rates."""
    _, turns_per_s = world.motor_turns()
    at_motors = float(torque @ turns_per_s) * 2 * math.pi
    at_joints = world.actuation.tau_from_motor @ torque @ world.data.qvel[world.joints.v_index]
    return float(at_joints), at_motors


def test_at_the_start_it_stands_level_where_the_planner_assumes_it(robot: RobotConfig) -> None:
    world = world_of(robot)
    truth = seen(world)
    assert truth.torso[2] == pytest.approx(robot.simulation.stand_height, abs=5e-4)
    assert truth.angles == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert truth.com[:2] == pytest.approx((0.0, 0.0), abs=1e-3)
    assert max(truth.foot_right_tilt, truth.foot_left_tilt) < 2e-3
    assert not truth.fallen
    world.placement.ankles += (0.2, 0.05, 0.0)
    assert seen(world).feet == pytest.approx((-0.2, -0.05), abs=1e-3)
    world.placement.ankles -= (0.2, 0.05, 0.0)
    for side, sign in zip(SIDES, (-1.0, 1.0), strict=True):
        foot = world.data.body(f"foot_{side}")
        wanted = (0.0, sign * robot.geometry.w_base / 2, 0.0)
        np.testing.assert_allclose(foot.xpos, wanted, atol=2e-3)
        assert foot.xpos[2] == pytest.approx(0.0, abs=1e-3)
        heading = foot.xmat.reshape(3, 3)[:, 0]
        assert heading[1] == pytest.approx(0.0, abs=2e-3)  # toes forward


@pytest.mark.parametrize("plant", [IDEAL, PlantConfig()], ids=["ideal", "realistic"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e39])
def test_a_torque_that_resets_mujoco_is_a_fall(
    robot: RobotConfig, bad: float, plant: PlantConfig
) -> None:
    world = World(body_of(robot, plant), STAND)
    world.remove_hoist()
    run(world, 0.1)
    assert not seen(world).fallen
    assert world.data.time == world.time
    torque = IDLE.copy()
    torque[3] = bad
    world.step(torque)
    run(world, 0.01)
    assert seen(world).fallen
    assert all(map(math.isfinite, (*world.data.qpos, *world.hidden())))


def test_motors_and_joints_agree_by_the_differential_and_have_the_same_power(
    robot: RobotConfig,
) -> None:
    """q_phi, q_theta = (m1 - m2) / 2N, (m1 + m2) / 2N (docs/law.md#the-robot)."""
    world = world_of(robot)
    rng = np.random.default_rng(1)
    q, v = rng.uniform(-1, 1, 12), rng.uniform(-1, 1, 12)
    world.data.qpos[world.joints.q_index] = q
    world.data.qvel[6:] = 0.0
    for index, name in enumerate(JOINTS):
        world.data.joint(name).qvel[0] = v[index]
    for turns, joints in zip(world.motor_turns(), (q, v), strict=True):
        m1, m2 = 2 * math.pi * turns[0::2], 2 * math.pi * turns[1::2]
        two_n = 2 * robot.joint.gear_ratio
        np.testing.assert_allclose((m1 - m2) / two_n, joints[0::2], atol=1e-12)
        np.testing.assert_allclose((m1 + m2) / two_n, joints[1::2], atol=1e-12)
    world = world_of(robot)
    rng = np.random.default_rng(2)
    for _ in range(20):
        world.data.qvel[:] = rng.normal(size=world.model.nv)
        at_joints, at_motors = powers(world, rng.normal(size=12))
        assert at_joints == pytest.approx(at_motors, rel=1e-12)
        assert abs(at_motors) > 1e-3
    world = world_of(robot)
    torque = np.zeros(12)
    torque[2:4] = 1.0  # both motors of the right knee
    world.step(torque)
    assert world.data.joint("knee_right_theta").qfrc_applied[0] == pytest.approx(
        2 * robot.joint.gear_ratio
    )
    assert world.data.joint("knee_right_phi").qfrc_applied[0] == pytest.approx(0.0)


def test_the_hoist_holds_an_unpowered_robot_which_falls_once_it_is_released(
    robot: RobotConfig,
) -> None:
    world = world_of(robot)
    run(world, 2.0)
    truth = seen(world)
    assert truth.hoist == 1.0
    assert not truth.fallen
    assert truth.torso[2] == pytest.approx(robot.simulation.stand_height, abs=0.03)
    assert max(truth.foot_right_tilt, truth.foot_left_tilt) < 0.01
    assert truth.feet_slip < 5e-3
    world = world_of(robot)
    run(world, 0.5)
    world.release_hoist()
    run(world, robot.simulation.hoist_s / 2)
    assert seen(world).hoist == pytest.approx(0.5, abs=0.01)
    run(world, robot.simulation.hoist_s / 2 + 3.0)
    truth = seen(world)
    assert truth.hoist == 0.0
    assert truth.fallen
    assert 0.05 < truth.torso[2] < 0.3, "it lies on the floor"


def test_a_push_moves_a_free_body_by_its_impulse_once_the_scenario_runs(robot: RobotConfig) -> None:
    """In the air, hoist gone: the momentum gained is the impulse, and no more after its end."""
    push = Push(at=0.02, duration=0.1, force=(40.0, -20.0, 10.0))
    world = world_of(robot, push=(push,))
    world.remove_hoist()
    world.data.qpos[2] += 5.0
    world.start()
    run(world, 0.2)
    assert world.outside.push == (0.0, 0.0, 0.0)
    momentum = _momentum(world)
    one_step = 40.0 * world.timestep
    np.testing.assert_allclose(momentum[:2], (4.0, -2.0), atol=1.01 * one_step)
    assert momentum[2] == pytest.approx(1.0 - 74.58 * GRAVITY * 0.2, rel=0.01)
    world = world_of(robot, push=(Push(at=0.0, duration=1.0, force=(500.0, 0.0, 0.0)),))
    run(world, 0.05)
    assert world.scenario_s < 0.0
    assert world.outside.push == (0.0, 0.0, 0.0)
    assert seen(world).push == (0.0, 0.0, 0.0)


def _momentum(world: World) -> Array:
    """Return the whole robot's momentum (3,), N s, from where its COM is 2 ms later."""
    before = world.data.subtree_com[0].copy()
    run(world, 0.002)
    return np.asarray(74.58 * (world.data.subtree_com[0] - before) / 0.002, float)


@pytest.mark.parametrize("pitch", [0.0, 0.6, 1.2])
def test_the_harness_feels_hand_and_load_in_torso_axes(robot: RobotConfig, pitch: float) -> None:
    """Hand up, load down, along world z; turned into the torso, the hand's moment about its y."""
    lead = Keyframe(at=0.0, height=1.25, pitch=pitch + 0.1, assist=120.0)
    world = world_of(robot, hand=True, keyframe=(lead,))
    world.remove_hoist()
    world.data.qpos[3:7] = (math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0)
    run(world, 0.002)
    R = world.data.body("torso").xmat.reshape(3, 3)
    truth = seen(world)
    assert truth.load_n == 120.0
    assert truth.harness_force_z == pytest.approx(120.0 - world.outside.hand.force_z)
    upward = R @ np.array(world.outside.harness_force)
    np.testing.assert_allclose(upward, (0.0, 0.0, world.outside.hand.force_z - 120.0), atol=1.5)
    assert world.outside.harness_moment == (0.0, world.outside.hand.moment_pitch, 0.0)
    assert world.outside.hand.moment_pitch != 0.0
    np.testing.assert_allclose(
        truth.operator_moment, R[:, 1] * world.outside.hand.moment_pitch, atol=6e-6
    )
    force = (0.0, 0.0, world.outside.hand.force_z)
    assert truth.operator_force == pytest.approx(force, abs=6e-6)


@pytest.mark.parametrize("com_offset", [[0.0, 0.0, 0.0], [0.05, -0.04, 0.03]])
def test_what_the_harness_feels_is_what_acts_on_the_torso_wherever_the_payload_is(
    robot: RobotConfig, com_offset: list[float]
) -> None:
    """Same wrench: at the harness point in torso axes, and in world's at the torso's COM.

    There MuJoCo takes outside forces.
    """
    lead = Keyframe(at=0.0, height=1.3, pitch=0.5, assist=80.0, side=0.05)
    plant = changed(IDEAL, {"body.com_offset": com_offset})
    scenario = msgspec.structs.replace(STAND, hand=True, keyframe=(lead,))
    world = World(body_of(robot, plant), scenario)
    world.remove_hoist()
    world.data.qpos[3:7] = (math.cos(0.3), math.sin(0.3) * 0.6, math.sin(0.3) * 0.8, 0.0)
    world.data.qvel[:] = 0.0
    world.step(IDLE)  # the pose set above is known to the world from its next step on
    torso = world.model.body("torso").id
    R = world.data.xmat[torso].reshape(3, 3).copy()
    world.step(IDLE)
    force = R @ np.array(world.outside.harness_force)
    com = world.model.body_ipos[torso]
    arm = R @ (np.array(robot.geometry.harness_point) - com)
    moment = R @ np.array(world.outside.harness_moment) + np.cross(arm, force)
    assert np.abs(force[1:]).min() > 10.0
    assert seen(world).operator_force[1] == pytest.approx(force[1])
    np.testing.assert_allclose(world.data.xfrc_applied[torso], [*force, *moment], atol=1e-9)
