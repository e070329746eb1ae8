"""Small sines of one joint: on a bench joint, and on a leg of the simulated robot."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from services.joint.drivers.base import DriveStatus
from services.simulator.physics.plant import PlantConfig, changed
from shared.can.cansimple import AxisState
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import MODULE_INDEX
from tests.tools.bringup.identify.hung_robot import HungDrive, HungRobot
from tests.tools.verbs.bench_drive import START, BenchDrive
from tools.bringup import motion_runner
from tools.bringup.hanging_leg import HangingJoint, hanging_joint, leg_of
from tools.bringup.identify.estimates import (
    JointResult,
    ParameterEstimate,
    Verdict,
    changes,
    measured,
    of_joints,
)
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


def hung_leg(hung: HungRobot, module: str = MODULE) -> dict[str, HungDrive]:
    return {name: hung.drives[name] for name in leg_of(module)}


def run(
    hung: HungRobot,
    robot: RobotConfig,
    module: str = MODULE,
    axis: int = 0,
    progress: Callable[[Sample], None] = lambda _: None,
) -> tuple[MotionResult, SinePlan, HangingJoint]:
    """Move a joint by sines, its leg's other modules held."""
    leg, interrupts = hung_leg(hung, module), Interrupts()
    q = look_at(leg, robot, interrupts, hung.clock)
    assert q is not None
    joint = hanging_joint(robot, q, module, axis)
    plan = plan_for(axis, 15.0, robot.joint.armature, joint)
    result = run_motion(
        leg, limited(robot, plan), module, plan, q_seen=q[module], interrupts=interrupts,
        progress=progress, clock=hung.clock,
    )  # fmt: skip
    return result, plan, joint


def identified(
    hung: HungRobot, robot: RobotConfig, module: str
) -> tuple[dict[str, ParameterEstimate], SinePlan]:
    """Return what theta's sines show, by its name without the joint's."""
    result, plan, joint = run(hung, robot, module, 1)
    assert (result.trouble, result.not_idle) == ("", ())
    fit = fit_sines(result.samples, plan)
    assert fit is not None
    rows = of_joints([JointResult(f"{module}_theta", fit, joint.inertia)], robot)
    return {row.what.removesuffix(f" {module}_theta"): row for row in rows}, plan


def test_an_ankles_rotor_and_friction_are_found_within_their_intervals(robot: RobotConfig) -> None:
    rotor = {"rotor_inertia": 0.11, "motor_friction": 0.5, "motor_damping": 1.0}
    planted = {f"drivetrain.{name}": value for name, value in rotor.items()}
    plant = changed(PlantConfig(), {"steps": 4} | planted)
    rows, _ = identified(HungRobot(robot, plant), robot, MODULE)
    assert rows["dry friction"].describes(0.6)
    assert rows["viscous friction"].describes(1.2)
    assert rows["reflected inertia"].describes(0.11)
    assert rows["reflected inertia"].verdict is Verdict.CHANGE
    values = list(rows.values())
    assert changes(values, robot).keys() == measured(values) == {"joint.armature"}


def test_a_knee_that_hangs_on_its_stop_is_led_off_it_and_its_friction_found(
    robot: RobotConfig,
) -> None:
    rows, plan = identified(HungRobot(robot, PlantConfig(steps=2)), robot, "knee_left")
    assert plan.bias[1] < -0.2
    assert rows["dry friction"].describes(0.3)
    assert rows["inertia"].verdict is Verdict.AGREES
    # two percent of a leg are more than the rotor
    assert rows["reflected inertia"].verdict is Verdict.UNKNOWN


def test_a_leg_that_swings_is_waited_for_but_not_for_ever(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    hung, interrupts = HungRobot(robot, PlantConfig()), Interrupts()
    hung.world.data.qvel[6:] = 0.5
    monkeypatch.setattr(motion_runner, "STILL_WAIT_S", 1.0)
    with pytest.raises(DriveError, match="swings"):
        look_at(hung_leg(hung), robot, interrupts, hung.clock)
    interrupts.number = 2
    assert look_at(hung_leg(hung), robot, interrupts, hung.clock) is None


def all_idle(hung: HungRobot) -> bool:
    readings = [drive.read(0.02) for drive in hung_leg(hung).values()]
    return all(one is not None and one.status is not DriveStatus.ARMED for one in readings)


def at_third(then: Callable[[], None]) -> tuple[list[Sample], Callable[[Sample], None]]:
    """Return what is seen of a motion, and who does something at the third look."""
    seen: list[Sample] = []

    def progress(sample: Sample) -> None:
        seen.append(sample)
        if len(seen) == 3:
            then()

    return seen, progress


def test_all_are_idle_again_when_a_held_module_does_not_arm(robot: RobotConfig) -> None:
    hung = HungRobot(robot, PlantConfig())
    hung.drives["hip_left"].never_arms = True
    result, *_ = run(hung, robot)
    assert "hip_left: it does not arm" in result.trouble
    assert result.not_idle == ()
    assert all_idle(hung)


@pytest.mark.parametrize("name", ["knee_left", "hip_left"])
def test_a_held_module_that_disarms_stops_the_motion(robot: RobotConfig, name: str) -> None:
    hung = HungRobot(robot, PlantConfig())

    def disarm() -> None:
        for axis in (0, 1):
            hung.bank.request_state(2 * MODULE_INDEX[name] + axis, AxisState.IDLE)

    seen, progress = at_third(disarm)
    result, *_ = run(hung, robot, progress=progress)
    assert result.trouble.startswith(f"{name}: the drive is IDLE")
    assert len(seen) < 8
    assert all_idle(hung)


def test_a_held_modules_target_goes_out_in_every_cycle(robot: RobotConfig) -> None:
    """A frame may be lost: the drive would be armed and hold nothing."""
    hung = HungRobot(robot, PlantConfig())

    def lose_gains() -> None:
        hung.bank.pos_gain[:] = 0.0
        hung.bank.vel_gain[:] = 0.0

    _, progress = at_third(lose_gains)
    result, *_ = run(hung, robot, progress=progress)
    assert result.trouble == ""
    assert hung.bank.pos_gain[2 * MODULE_INDEX["knee_left"]] > 0.0


def test_an_exception_idles_the_whole_leg(robot: RobotConfig) -> None:
    hung = HungRobot(robot, PlantConfig())

    def fail(_: Sample) -> None:
        raise RuntimeError("a test")

    with pytest.raises(RuntimeError):
        run(hung, robot, progress=fail)
    assert all_idle(hung)


def test_a_drive_that_raises_while_it_is_idled_leaves_no_other_armed(robot: RobotConfig) -> None:
    hung = HungRobot(robot, PlantConfig())
    hung.drives["hip_left"].never_arms = True

    def broken() -> None:
        raise OSError("a test")

    hung.drives[MODULE].idle = broken  # type: ignore[method-assign]
    with pytest.raises(OSError, match="a test"):
        run(hung, robot)
    assert all_idle(hung)


def test_drives_that_do_not_say_that_they_are_idle_are_named(robot: RobotConfig) -> None:
    hung = HungRobot(robot, PlantConfig())
    hung.drives["knee_left"].deaf = True
    hung.drives["hip_left"].never_arms = True
    result, *_ = run(hung, robot)
    assert result.not_idle == ("knee_left",)


def test_a_torque_beyond_the_robots_is_refused(robot: RobotConfig) -> None:
    plan = sines(0, 0.17, torque=500.0)
    with pytest.raises(DriveError, match="torque"):
        limited(robot, plan)


def test_limits_at_the_stops_are_wider_than_the_soft_ones(robot: RobotConfig) -> None:
    wide = within_stops(robot)
    assert wide.limits.knee.theta[1] > robot.limits.knee.theta[1]
    assert msgspec.structs.replace(wide, limits=robot.limits) == robot
