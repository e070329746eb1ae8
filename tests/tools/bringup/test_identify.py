"""Small sines of one joint: on a bench joint, and on a leg of the simulated robot."""

from __future__ import annotations

import pytest

from services.simulator.physics.plant import PlantConfig, changed
from shared.config.robot_config import RobotConfig
from tests.tools.bringup.bench_drive import BenchDrive, move
from tests.tools.bringup.hung_robot import HungRobot
from tools.bringup.hanging_leg import HangingJoint, hanging_joint
from tools.bringup.identify import (
    Estimate,
    JointResult,
    SinePlan,
    Verdict,
    estimates_of,
    fit_sines,
    plan_for,
)
from tools.bringup.motion import limit_drives, within_stops
from tools.bringup.motion_runner import Interrupts, hanging_angles


def sines(axis: int, inertia: float, gravity: float = 0.0) -> SinePlan:
    return plan_for(axis, 15.0, 0.0, HangingJoint(inertia, gravity, (0.0, 0.0)))


def test_heavy_joints_are_moved_slowly_and_within_the_torque() -> None:
    light, heavy = sines(0, 0.17).course.tones, sines(0, 15.0, 134.0).course.tones
    assert max(tone.frequency_hz for tone in heavy) < 1.0
    assert light[0].amplitude > heavy[0].amplitude
    assert all(134.0 * tone.amplitude < 15.0 for tone in heavy)


@pytest.mark.parametrize(("friction", "axis"), [(1.0, 0), (0.4, 1)])
def test_a_bench_joint_has_the_inertia_and_friction_that_it_has(
    robot: RobotConfig, friction: float, axis: int
) -> None:
    plan = sines(axis, 0.5)
    limited = limit_drives(robot, plan)
    drive = BenchDrive(limited)
    drive.friction = friction
    result = drive.run(limited, plan)
    assert (result.trouble, result.not_idle) == ("", ())
    fit = fit_sines(result.samples, plan)
    assert fit is not None
    for truth, (value, sd) in ((0.5, fit.inertia), (0.5, fit.viscous), (friction, fit.dry)):
        assert abs(value - truth) < 1.96 * sd
    assert fit_sines(result.samples[:3000], plan) is None


def identified(
    plant: PlantConfig, robot: RobotConfig, module: str
) -> tuple[dict[str, Estimate], SinePlan]:
    """Return what theta's sines show of a leg that hangs, by its name without the joint's."""
    hung = HungRobot(robot, plant)
    leg = hung.leg(module)
    q = hanging_angles(leg, robot, Interrupts(), hung.clock)
    assert q is not None
    joint = hanging_joint(robot, q, module, 1)
    plan = plan_for(1, 15.0, robot.joint.armature, joint)
    limited = limit_drives(within_stops(robot), plan)
    result = move(leg, limited, module, plan, q[module], hung.clock)
    assert (result.trouble, result.not_idle) == ("", ())
    fit = fit_sines(result.samples, plan)
    assert fit is not None
    rows = estimates_of([JointResult(f"{module}_theta", fit, joint.inertia)], robot)
    return {row.what.removesuffix(f" {module}_theta"): row for row in rows}, plan


def test_an_ankles_rotor_and_friction_are_found_within_their_intervals(robot: RobotConfig) -> None:
    rotor = {"rotor_inertia": 0.11, "motor_friction": 0.5, "motor_damping": 1.0}
    planted = {f"drivetrain.{name}": value for name, value in rotor.items()}
    rows, _ = identified(changed(PlantConfig(), {"steps": 2} | planted), robot, "ankle_left")
    assert rows["dry friction"].describes(0.6)
    assert rows["viscous friction"].describes(1.2)
    assert rows["reflected inertia"].describes(0.11)
    assert rows["reflected inertia"].verdict is Verdict.CHANGE


def test_a_knee_that_hangs_on_its_stop_is_led_off_it_and_its_friction_found(
    robot: RobotConfig,
) -> None:
    rows, plan = identified(PlantConfig(), robot, "knee_left")
    assert plan.bias[1] < -0.2
    assert rows["dry friction"].describes(0.3)
    assert rows["inertia"].verdict is Verdict.AGREES
    # two percent of a leg are more than the rotor
    assert rows["reflected inertia"].verdict is Verdict.UNKNOWN
