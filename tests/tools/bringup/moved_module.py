"""Motions of a module on a bench and of a leg that hangs, by the one runner, in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from services.joint.drivers.base import Drive
from shared.bus.messages import Pair
from shared.config.robot_config import RobotConfig
from tests.tools.bringup.bench_drive import START, BenchDrive
from tests.tools.bringup.hung_robot import HungDrive, HungRobot
from tools.bringup.hanging_leg import HangingJoint, hanging_joint, leg_of
from tools.bringup.identify.sines import SinePlan, plan_for
from tools.bringup.jog import JogPlan, ThereAndBack
from tools.bringup.motion import AnyPlan, Sample, limit_drives, within_stops
from tools.bringup.motion_runner import Interrupts, MotionResult, hanging_angles, run_motion

MODULE = "knee_left"
PLAN = JogPlan(axis=1, course=ThereAndBack(0.05, 2.0, 2), torque_limit=10.0)
Progress = Callable[[Sample], None]


def unwatched(_: Sample) -> None:
    """See nothing."""


def jog_by(rad: float) -> JogPlan:
    return PLAN._replace(course=PLAN.course._replace(by=rad))


def move(
    drives: Mapping[str, Drive],
    robot: RobotConfig,
    module: str,
    plan: AnyPlan,
    q_seen: Pair,
    clock: Callable[[], int],
    progress: Progress = unwatched,
    interrupts: Interrupts | None = None,
) -> MotionResult:
    return run_motion(
        drives, robot, module, plan, q_seen=q_seen, interrupts=interrupts or Interrupts(),
        progress=progress, clock=clock,
    )  # fmt: skip


def on_bench(
    drive: BenchDrive,
    robot: RobotConfig,
    plan: AnyPlan = PLAN,
    *,
    q_seen: Pair = START,
    progress: Progress = unwatched,
    interrupts: Interrupts | None = None,
) -> MotionResult:
    """Return how a motion of a module on a bench ended; robot: as of `limit_drives`."""
    drives = {MODULE: drive}
    return move(drives, robot, MODULE, plan, q_seen, drive.clock, progress, interrupts)


def leg_drives(hung: HungRobot, module: str) -> dict[str, HungDrive]:
    return {name: hung.drives[name] for name in leg_of(module)}


def hanging(
    hung: HungRobot, robot: RobotConfig, module: str, axis: int, progress: Progress = unwatched
) -> tuple[MotionResult, SinePlan, HangingJoint]:
    """Return how sines of a joint ended, its leg's other modules held."""
    leg = leg_drives(hung, module)
    q = hanging_angles(leg, robot, Interrupts(), hung.clock)
    assert q is not None
    joint = hanging_joint(robot, q, module, axis)
    plan = plan_for(axis, 15.0, robot.joint.armature, joint)
    limited = limit_drives(within_stops(robot), plan)
    return move(leg, limited, module, plan, q[module], hung.clock, progress), plan, joint
