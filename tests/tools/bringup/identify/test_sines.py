"""Small sines of one joint: on a bench joint, and on a leg of the simulated robot."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from services.joint.drivers.base import DriveStatus
from services.simulator.physics.plant import PlantConfig, changed
from shared.can.cansimple import AxisState
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import MODULE_INDEX
from tests.tools.bringup.identify.hung_robot import HungRobot
from tests.tools.verbs.bench_drive import START, BenchDrive
from tools.bringup import motion_runner
from tools.bringup.hanging_leg import HangingJoint, hanging_joint, leg_of
from tools.bringup.identify.estimates import JointResult, Verdict, changes, measured, of_joints
from tools.bringup.identify.sines import SinePlan, fit_sines, plan_for
from tools.bringup.motion import AnyPlan, Sample, limit_drives, within_stops
from tools.bringup.motion_runner import Interrupts, MotionResult, look_at, run_motion

MODULE = "ankle_left"


def sines(axis: int, inertia: float, gravity: float = 0.0, torque: float = 15.0) -> SinePlan:
    return plan_for(axis, torque, 0.0, HangingJoint(inertia, gravity, (0.0, 0.0)))


def limited(robot: RobotConfig, plan: AnyPlan) -> RobotConfig:
    return limit_drives(within_stops(robot), plan)


def test_the_plan_is_smooth_stays_in_its_reach_and_ends_where_it_began() -> None:
    plan = plan_for(1, 15.0, 0.0, HangingJoint(9.4, 88.0, (0.0, -0.3)))
    t = np.linspace(0.0, plan.duration_s, 60001)
    q, v = np.array([[pair[1] for pair in plan.offset(float(one))] for one in t]).T
    assert (q[0], q[-1]) == pytest.approx((0.0, 0.0), abs=1e-12)
    low, high = plan.reach[1]
    assert low - 1e-9 <= q.min()
    assert max(q.max(), 0.0) <= max(high, 0.0) + 1e-9
    assert np.abs(v).max() <= 1.2 * plan.course.rate_max + 0.3
    np.testing.assert_allclose(np.gradient(q, t), v, atol=2e-3)


def test_heavy_joints_are_moved_slowly_and_within_the_torque() -> None:
    light, heavy = sines(0, 0.17), sines(0, 15.0, 134.0)
    assert max(tone.frequency_hz for tone in heavy.course.tones) < 1.0
    assert light.course.tones[0].amplitude > heavy.course.tones[0].amplitude
    for tone in heavy.course.tones:
        assert 134.0 * tone.amplitude < 15.0


@pytest.mark.parametrize(("friction", "axis"), [(1.0, 0), (0.4, 1)])
def test_a_bench_joint_has_the_inertia_and_friction_that_it_has(
    robot: RobotConfig, friction: float, axis: int
) -> None:
    plan = sines(axis, 0.5)
    limited = limit_drives(robot, plan)
    drive = BenchDrive(limited)
    drive.friction = friction
    result = run_motion(
        {"knee_left": drive}, limited, "knee_left", plan, q_seen=START, interrupts=Interrupts(),
        progress=lambda _: None, clock=drive.clock,
    )  # fmt: skip
    assert (result.trouble, result.not_idle) == ("", ())
    fit = fit_sines(result.samples, plan)
    assert fit is not None
    for truth, (value, sd) in ((0.5, fit.inertia), (0.5, fit.viscous), (friction, fit.dry)):
        assert abs(value - truth) < 1.96 * sd
    assert fit_sines(result.samples[:3000], plan) is None


def moved(
    hung: HungRobot, robot: RobotConfig, module: str, axis: int
) -> tuple[JointResult, SinePlan]:
    leg = {name: hung.drives[name] for name in leg_of(module)}
    interrupts = Interrupts()
    q = look_at(leg, robot, interrupts, hung.clock)
    assert q is not None
    joint = hanging_joint(robot, q, module, axis)
    plan = plan_for(axis, 15.0, robot.joint.armature, joint)
    result = run_motion(
        leg, limited(robot, plan), module, plan, q_seen=q[module], interrupts=interrupts,
        progress=lambda _: None, clock=hung.clock,
    )  # fmt: skip
    assert (result.trouble, result.not_idle) == ("", ())
    fit = fit_sines(result.samples, plan)
    assert fit is not None
    return JointResult(f"{module}_{'phi' if axis == 0 else 'theta'}", fit, joint.inertia), plan


def test_an_ankles_rotor_and_friction_are_found_within_their_intervals(robot: RobotConfig) -> None:
    plant = changed(
        PlantConfig(),
        {
            "steps": 4,
            "drivetrain.rotor_inertia": 0.11,
            "drivetrain.motor_friction": 0.5,
            "drivetrain.motor_damping": 1.0,
        },
    )
    result, _ = moved(HungRobot(robot, plant), robot, MODULE, 1)
    rows = {row.what.split(" ankle")[0]: row for row in of_joints([result], robot)}
    assert rows["dry friction"].describes(0.6)
    assert rows["viscous friction"].describes(1.2)
    assert rows["reflected inertia"].describes(0.11)
    assert rows["reflected inertia"].verdict is Verdict.CHANGE
    values = changes(list(rows.values()), robot)
    assert values.keys() == {"joint.armature"}
    assert measured(list(rows.values())) == {"joint.armature"}


def test_a_knee_that_hangs_on_its_stop_is_led_off_it_and_its_friction_found(
    robot: RobotConfig,
) -> None:
    result, plan = moved(HungRobot(robot, PlantConfig(steps=2)), robot, "knee_left", 1)
    assert plan.bias[1] < -0.2
    rows = {row.what.split(" knee")[0]: row for row in of_joints([result], robot)}
    assert rows["dry friction"].describes(0.3)
    assert rows["inertia"].verdict is Verdict.AGREES
    # two percent of a leg are more than the rotor
    assert rows["reflected inertia"].verdict is Verdict.UNKNOWN


def test_a_leg_that_swings_is_waited_for_but_not_for_ever(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    hung = HungRobot(robot, PlantConfig())
    hung.world.data.qvel[6:] = 0.5
    leg = {name: hung.drives[name] for name in leg_of(MODULE)}
    interrupts = Interrupts()
    monkeypatch.setattr(motion_runner, "STILL_WAIT_S", 1.0)
    with pytest.raises(DriveError, match="swings"):
        look_at(leg, robot, interrupts, hung.clock)
    interrupts.number = 2
    assert look_at(leg, robot, interrupts, hung.clock) is None


def started(hung: HungRobot, robot: RobotConfig, **change: object) -> MotionResult:
    """Return how a motion of the left ankle ended, with the leg's other modules held."""
    leg = {name: hung.drives[name] for name in leg_of(MODULE)}
    interrupts = Interrupts()
    q = look_at(leg, robot, interrupts, hung.clock)
    assert q is not None
    plan = plan_for(0, 15.0, robot.joint.armature, hanging_joint(robot, q, MODULE, 0))
    words = {"q_seen": q[MODULE], "interrupts": interrupts, "clock": hung.clock}
    words |= {"progress": lambda _: None} | change
    return run_motion(leg, limited(robot, plan), MODULE, plan, **words)  # type: ignore[arg-type]


def all_idle(hung: HungRobot) -> bool:
    readings = [hung.drives[name].read(0.02) for name in leg_of(MODULE)]
    return all(one is not None and one.status is not DriveStatus.ARMED for one in readings)


def test_all_are_idle_again_when_a_held_module_does_not_arm(robot: RobotConfig) -> None:
    hung = HungRobot(robot, PlantConfig())
    hung.drives["hip_left"].never_arms = True
    result = started(hung, robot)
    assert "hip_left: it does not arm" in result.trouble
    assert result.not_idle == ()
    assert all_idle(hung)


@pytest.mark.parametrize("name", ["knee_left", "hip_left"])
def test_a_held_module_that_disarms_or_moves_stops_the_motion(
    robot: RobotConfig, name: str
) -> None:
    hung, seen = HungRobot(robot, PlantConfig()), []

    def progress(sample: Sample) -> None:
        seen.append(sample)
        if len(seen) == 3:
            for axis in (0, 1):
                hung.bank.request_state(2 * MODULE_INDEX[name] + axis, AxisState.IDLE)

    result = started(hung, robot, progress=progress)
    assert result.trouble.startswith(f"{name}: the drive is IDLE")
    assert len(seen) < 8
    assert all_idle(hung)


def test_a_held_modules_target_goes_out_in_every_cycle(robot: RobotConfig) -> None:
    """A frame may be lost: the drive would be armed and hold nothing."""
    hung, seen = HungRobot(robot, PlantConfig()), []

    def progress(sample: Sample) -> None:
        seen.append(sample)
        if len(seen) == 3:  # as if its gains had not arrived
            hung.bank.pos_gain[:] = 0.0
            hung.bank.vel_gain[:] = 0.0

    result = started(hung, robot, progress=progress)
    assert result.trouble == ""
    knee = 2 * MODULE_INDEX["knee_left"]
    assert hung.bank.pos_gain[knee] > 0.0


def test_an_exception_idles_the_whole_leg(robot: RobotConfig) -> None:
    hung = HungRobot(robot, PlantConfig())

    def progress(_: Sample) -> None:
        raise RuntimeError("a test")

    with pytest.raises(RuntimeError):
        started(hung, robot, progress=progress)
    assert all_idle(hung)


def test_drives_that_do_not_say_that_they_are_idle_are_named(robot: RobotConfig) -> None:
    hung = HungRobot(robot, PlantConfig())
    hung.drives["knee_left"].deaf = True
    hung.drives["hip_left"].never_arms = True
    assert started(hung, robot).not_idle == ("knee_left",)


def test_a_torque_beyond_the_robots_is_refused(robot: RobotConfig) -> None:
    plan = sines(0, 0.17, torque=500.0)
    with pytest.raises(DriveError, match="torque"):
        limited(robot, plan)


def test_limits_at_the_stops_are_wider_than_the_soft_ones(robot: RobotConfig) -> None:
    wide = within_stops(robot)
    assert wide.limits.knee.theta[1] > robot.limits.knee.theta[1]
    assert msgspec.structs.replace(wide, limits=robot.limits) == robot
