"""The flexible drivetrain, and the plant: realistic by default, hidden from controllers."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from services.simulator.physics.actuation import FlexibleDrivetrain
from services.simulator.physics.body import body_of
from services.simulator.physics.plant import (
    IDEAL,
    Drivetrain,
    PlantConfig,
    changed,
    load,
    plant_from,
    to_toml,
)
from services.simulator.physics.world import World
from shared.config.robot_config import RobotConfig
from tests.lockstep.runs import run, standing_as, still, variant
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import Lockstep

WRONG = {
    "body.payload_scale": 0.85,
    "body.com_offset": [0.015, -0.01, 0.02],
    "encoder.zero_errors": [0.008] * 12,
    "floor.slope": [0.02, -0.01],
    "floor.step": 0.003,
    "drive.torque_scale": 0.95,
}


def test_a_plant_is_realistic_by_default_and_words_are_laid_over_one_another() -> None:
    plant = PlantConfig()
    assert plant.drivetrain.stiffness == 8000.0
    assert plant.drivetrain.play > 0.0
    assert plant.drive.lag_s > 0.0
    assert plant.person.mass == 80.0
    plant = plant_from(["ideal", "drivetrain.play=0.01", "floor.slope=[0.02, 0.0]"])
    assert plant.drivetrain.stiffness == np.inf
    assert plant.drivetrain.play == 0.01
    assert plant.floor.slope == (0.02, 0.0)


def test_a_plant_written_as_toml_is_read_back(tmp_path: Path) -> None:
    plant = changed(PlantConfig(), WRONG)
    file = tmp_path / "plant.toml"
    file.write_text(to_toml(plant), encoding="utf-8")
    assert load(file) == plant
    file.write_text(to_toml(IDEAL), encoding="utf-8")
    assert load(file) == IDEAL  # a rigid drivetrain has an infinite stiffness


def test_no_controller_sees_the_plant(robot: RobotConfig) -> None:
    """Planner and joint services are made of the robot file alone, whatever the plant."""
    right, wrong = (
        Lockstep(robot, variant("stand"), plant=plant)
        for plant in (PlantConfig(), changed(PlantConfig(), WRONG))
    )
    right_moment, wrong_moment = right.moment(), wrong.moment()
    assert right_moment.planner is not None
    assert msgspec.json.encode(right_moment.planner) == msgspec.json.encode(wrong_moment.planner)
    assert dict(right_moment.modules) == dict(wrong_moment.modules)
    assert right.config is wrong.config is robot


def test_errors_change_the_true_robot_and_not_the_file(robot: RobotConfig) -> None:
    true, believed = (body_of(robot, plant) for plant in (changed(IDEAL, WRONG), IDEAL))
    lighter = 0.15 * robot.mass.payload * 9.81
    assert believed.weight - true.weight == pytest.approx(lighter, rel=1e-6)
    torso = true.model.body("torso").id
    np.testing.assert_allclose(
        true.model.body_ipos[torso] - believed.model.body_ipos[torso], [0.015, -0.01, 0.02]
    )
    assert true.model.opt.gravity[0] == pytest.approx(-9.81 * np.sin(0.02))
    assert np.linalg.norm(true.model.opt.gravity) == pytest.approx(9.81)


def test_errors_show_in_encoders_and_feet_and_the_world_keeps_nothing_of_the_file(
    robot: RobotConfig,
) -> None:
    errors = np.linspace(-0.01, 0.01, 12)
    plant = changed(IDEAL, {"encoder.zero_errors": errors.tolist()})
    wrong, right = (World(body_of(robot, one), variant("stand")) for one in (plant, IDEAL))
    shown = wrong.motor_turns()[0] - right.motor_turns()[0]
    joints = np.linalg.solve(body_of(robot, IDEAL).motor_from_joint, shown)
    np.testing.assert_allclose(joints, errors, atol=1e-9)
    for step in (0.01, -0.01):
        world = World(body_of(robot, changed(IDEAL, {"floor.step": step})), variant("stand"))
        truth = world.truth(0, 1.0, 0.0)
        assert max(truth.foot_right_tilt, truth.foot_left_tilt) < 2e-3
        right, left = (world.data.body(f"foot_{side}").xpos[2] for side in ("right", "left"))
        assert right - left == pytest.approx(step, abs=1e-3)
    # What is true and what is believed share no configuration object.
    world = World(body_of(robot, PlantConfig()), variant("stand"))
    objects = (world, world.actuation, world.outside, world.placement)
    parts = [part for each in objects for part in vars(each).values()]
    assert len(parts) > 40
    assert not any(isinstance(part, RobotConfig) for part in parts)


def test_drawn_plants_stay_in_their_ranges_repeat_and_widen_about_the_middle() -> None:
    ranges = plants.shipped().error
    for number in range(50):
        plant = plants.draw(f"test {number}")
        assert plant == plants.draw(f"test {number}")
        table = msgspec.to_builtins(plant)
        for row in ranges:
            section, _, name = row.key.partition(".")
            value = table[section][name]
            for one in value if isinstance(value, (list, tuple)) else (value,):
                assert row.low - 1e-9 <= one <= row.high * (1 + 1e-5)
    assert plants.draw("test 1") != plants.draw("test 2")
    wide = [plants.errors_of(plants.draw(f"wide {n}", beyond=2.0)) for n in range(100)]
    assert max(row["drivetrain.play"] for row in wide) > 0.0044
    assert min(row["drivetrain.stiffness"] for row in wide) < 3000.0
    assert min(row["drivetrain.play"] for row in wide) >= 0.0


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


def test_play_and_dry_friction_let_no_weak_torque_through(robot: RobotConfig) -> None:
    rotors = drivetrain(robot, play=0.02)
    rotors.rate[:] = 0.1
    tau = rotors.step(np.zeros(12), np.zeros(12), np.zeros(12))
    np.testing.assert_array_equal(tau, 0.0)
    np.testing.assert_array_equal(rotors.damping, 0.0)
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


@pytest.mark.sampled(2)
@pytest.mark.parametrize("stiffness", [2000.0, 20000.0])
def test_one_step_of_a_millisecond_does_as_well_as_four(
    robot: RobotConfig, stiffness: float
) -> None:
    """The rest of a lockstep run on the realistic plant hangs on this.

    Within 3 mm: dry friction lets the robot rest anywhere in a band, and the soles no longer creep.
    """
    plants_of = [
        changed(PlantConfig(), {"drivetrain.stiffness": stiffness, "steps": n}) for n in (1, 4)
    ]
    start = standing_as(robot, plants_of[0])
    coarse, fine = (
        run(robot, still(0.7, height=1.1), plant=plant, start=start) for plant in plants_of
    )
    assert coarse.rows[-1].scenario_s > 0.6
    n = min(len(coarse.rows), len(fine.rows))
    np.testing.assert_allclose(coarse.com_mm[:n], fine.com_mm[:n], atol=3.0)
