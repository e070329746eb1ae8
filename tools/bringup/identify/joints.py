"""`xrl identify joint`: moves the joints of a hanging leg one by one by small sines, and tells."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence

from shared.bus.messages import Pair
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.extras import require
from shared.joints import AXES, MODULES
from tools.bringup import module_motion
from tools.bringup.drive_access import drives_to_ourselves, robot_file
from tools.bringup.hanging_leg import hanging_joint
from tools.bringup.identify import report
from tools.bringup.identify.estimates import JointResult, of_joints
from tools.bringup.identify.robot_file_edit import refuse_running
from tools.bringup.identify.sines import SinePlan, fit_sines, plan_for
from tools.bringup.module_motion import Stopped
from tools.bringup.motion_runner import Interrupts
from tools.output import make_folder
from tools.terminal import Console


def run(args: argparse.Namespace, console: Console) -> int:
    """Measure the joints that are asked for; 0 if no motion was stopped."""
    modules, axes = _asked(args)
    if not args.dry_run:
        require("plot")
    path = robot_file(args)
    robot = config_file.load_without_schedule(path)
    if args.apply:
        refuse_running(path)
    results: list[JointResult] = []
    stopped: Stopped | None = None
    interrupts = Interrupts()
    module_motion.refuse_services(robot, modules, args.run_dir)
    with drives_to_ourselves(robot, path, args.run_dir, console.print, lifted=module_motion.LIFTED):
        for joint in ((module, axis) for module in modules for axis in axes):
            try:
                found = _measure(args, robot, joint, interrupts, console)
            except DriveError as error:
                if not results:
                    raise
                found = Stopped(str(error))  # what is measured by now is told
            if isinstance(found, Stopped):
                stopped = found
                break
            if found is not None:
                results.append(found)
    if results:
        estimates = of_joints(results, robot)
        picture = make_folder(args.out, "identify") / "joints.png"
        report.draw_joints(estimates, results, picture)
        report.tell(estimates, robot, path if args.apply else None, console)
        console.print(f"{picture}", style="dim")
    code = 0 if stopped is None else module_motion.tell_stopped(stopped, console)
    module_motion.exit_if_interrupted(interrupts)
    return code


def _asked(args: argparse.Namespace) -> tuple[Sequence[str], Sequence[int]]:
    """Return modules and axes."""
    unknown = [name for name in args.module if name not in MODULES]
    if unknown:
        raise DriveError(f"{unknown[0][:40]}: one of {', '.join(MODULES)} is right")
    if bool(args.module) == args.all:
        raise DriveError("name modules, or --all")
    if not args.torque > 0.0:
        raise DriveError(f"--torque {args.torque:g}: more than 0 N m is right")
    axes = (0, 1) if args.axis is None else (AXES.index(args.axis),)
    return (MODULES if args.all else args.module), axes


def _measure(
    args: argparse.Namespace,
    robot: RobotConfig,
    joint: tuple[str, int],
    interrupts: Interrupts,
    console: Console,
) -> JointResult | Stopped | None:
    """Measure one joint; return its result, how it was stopped, or None for a dry run."""
    name = f"{joint[0]}_{AXES[joint[1]]}"

    def plan_of(q: Mapping[str, Pair]) -> SinePlan:
        plan = plan_for(
            joint[1], args.torque, robot.joint.armature, hanging_joint(robot, q, *joint)
        )
        console.print(_described(name, plan))
        return plan

    moved = module_motion.ask_and_move(args, robot, joint, plan_of, interrupts, console)
    if not isinstance(moved, module_motion.Moved):
        return moved
    fit = fit_sines(moved.samples, moved.plan)
    if fit is None:
        return Stopped(f"{name}: too few samples for a fit; look at its bus (`xrl can test`)")
    return JointResult(name, fit, hanging_joint(robot, moved.q, *joint).inertia)


def _described(joint: str, plan: SinePlan) -> str:
    tones = ", ".join(
        f"{1e3 * t.amplitude:.0f} mrad at {t.frequency_hz:g} Hz" for t in plan.course.tones
    )
    phi, theta = plan.bias
    led = f"; led by {phi:+.2f}, {theta:+.2f} rad first" if any(plan.bias) else ""
    return (
        f"{joint}: {tones}, {plan.duration_s:.0f} s, at most {plan.torque_limit:.0f} N m{led}; the "
        "leg's other modules hold"
    )
