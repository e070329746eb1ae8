"""The flexible drivetrain: springs, play, friction, and that its steps are short enough."""

from __future__ import annotations

import numpy as np
import pytest

from services.simulator.physics.actuation import FlexibleDrivetrain
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import IDEAL, Drivetrain, PlantConfig, changed
from services.simulator.physics.world import World
from shared.config.robot_config import RobotConfig
from tests.lockstep.runs import still
from tools.sim.lockstep import Lockstep

DT = 1e-3
QUIET = {"motor_friction": 0.0, "cogging": 0.0, "play": 0.0}


def drivetrain(robot: RobotConfig, dt: float = DT, **changes: float) -> FlexibleDrivetrain:
    config = Drivetrain(**{**QUIET, **changes})
    return FlexibleDrivetrain(config, body_of(robot, IDEAL).motor_from_joint, dt)


def held(rotors: FlexibleDrivetrain, tau: float, seconds: float, dt: float = DT) -> None:
    """Apply a torque with every joint clamped at zero."""
    zero = np.zeros(12)
    for _ in range(round(seconds / dt)):
        rotors.step(np.full(12, tau), zero, zero)


@pytest.mark.parametrize(("play", "seconds", "rtol"), [(0.0, 2.0, 1e-6), (0.01, 3.0, 1e-4)])
def test_a_clamped_joint_stretches_the_spring_by_tau_over_k_and_half_its_play(
    robot: RobotConfig, play: float, seconds: float, rtol: float
) -> None:
    rotors = drivetrain(robot, stiffness=5000.0, play=play)
    held(rotors, 20.0, seconds)
    np.testing.assert_allclose(rotors.theta, 20.0 / 5000.0 + 0.5 * play, rtol=rtol)


def test_within_the_play_no_torque_reaches_the_joint(robot: RobotConfig) -> None:
    rotors = drivetrain(robot, play=0.02)
    rotors.rate[:] = 0.1
    tau = rotors.step(np.zeros(12), np.zeros(12), np.zeros(12))
    np.testing.assert_array_equal(tau, 0.0)
    np.testing.assert_array_equal(rotors.damping, 0.0)


def test_dry_friction_holds_what_is_weaker_than_it(robot: RobotConfig) -> None:
    rotors = drivetrain(robot, motor_friction=0.5)
    held(rotors, 0.45, 1.0)
    np.testing.assert_array_equal(rotors.theta, 0.0)
    held(rotors, 0.6, 1.0)
    assert (rotors.theta > 0.0).all()


def test_the_rotor_rings_at_the_root_of_k_over_i(robot: RobotConfig) -> None:
    k, inertia = 8000.0, 0.15
    dt = 1e-4
    rotors = drivetrain(
        robot, dt, stiffness=k, damping_s=1e-5, motor_damping=0.0, rotor_inertia=inertia
    )
    rotors.theta[:] = 0.01
    zero, course = np.zeros(12), []
    for _ in range(2000):
        rotors.step(zero, zero, zero)
        course.append(float(rotors.theta[0]))
    crossings = np.flatnonzero(np.diff(np.sign(course)))
    period = 2.0 * dt * np.diff(crossings).mean()
    assert 2.0 * np.pi / period == pytest.approx(np.sqrt(k / inertia), rel=0.01)


def test_energy_only_ever_leaves_a_drivetrain_that_is_not_driven(robot: RobotConfig) -> None:
    rotors = drivetrain(robot, stiffness=20000.0, play=0.004, motor_friction=0.1)
    rng = np.random.default_rng(3)
    rotors.theta[:], rotors.rate[:] = rng.normal(0, 0.01, 12), rng.normal(0, 1.0, 12)

    def energy() -> float:
        stretch = rotors.theta - np.clip(rotors.theta, -0.002, 0.002)
        return float(0.5 * 20000.0 * stretch @ stretch + 0.5 * 0.15 * rotors.rate @ rotors.rate)

    zero = np.zeros(12)
    before = [energy()]
    for _ in range(400):
        rotors.step(zero, zero, zero)
        before.append(energy())
    assert before[-1] < 0.01 * before[0]
    assert max(before) < 1.05 * before[0]  # the integrator breathes, it does not feed


def test_a_stiff_drivetrain_is_the_rigid_one(robot: RobotConfig) -> None:
    """The same stand under the same torques, by both kinds of plant."""
    courses = []
    for stiffness in (np.inf, 2e5):
        plant = changed(IDEAL, {"drivetrain.stiffness": stiffness, "steps": 4})
        world = World(body_of(robot, plant), still(1.0))
        for _ in range(300):
            world.step(np.full(12, 0.2))
        courses.append(world.data.qpos[:3].copy())
    np.testing.assert_allclose(courses[0], courses[1], atol=1e-4)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("stiffness", [2000.0, 20000.0])
def test_one_step_of_a_millisecond_does_as_well_as_four(
    robot: RobotConfig, stiffness: float
) -> None:
    """The rest of a lockstep run on the realistic plant hangs on this.

    Within 3 mm: dry friction lets the robot rest anywhere in a band, and the soles no longer creep.
    """
    coms = []
    for steps in (1, 4):
        plant = changed(PlantConfig(), {"drivetrain.stiffness": stiffness, "steps": steps})
        fleet = Lockstep(robot, still(1.5, height=1.1), plant=plant)
        coms.append(np.array([row.com for row in fleet.run() if row.scenario_s > 0.0]))
        assert fleet.world.scenario_s > 1.4
    n = min(map(len, coms))
    np.testing.assert_allclose(coms[0][:n], coms[1][:n], atol=3e-3)
