"""`xrl drive identify joint`: moves the joints of a hanging leg by small sines, and tells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from shared.bus.messages import Pair
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.extras import require
from shared.joints import AXES, MODULES
from shared.toml_file import Range
from tools.bringup import module_motion
from tools.bringup.drive_access import drives_to_ourselves, robot_file
from tools.bringup.hanging_leg import hanging_joint
from tools.bringup.identify import report
from tools.bringup.identify.estimates import JointResult, of_joints
from tools.bringup.identify.robot_file_edit import refuse_running
from tools.bringup.identify.sines import SinePlan, fit_sines, plan_for
from tools.bringup.module_motion import Stopped
from tools.bringup.motion_runner import Interrupts
from tools.flags import FINITE_MAX, Arg, Folder, MotionFlags, positional
from tools.output import make_folder
from tools.terminal import Console


class JointFlags(MotionFlags):
    """Which joints, and how hard they are moved."""

    module: Annotated[tuple[str, ...], positional("MODULE", exclusive="which!")] = ()
    """which; or --all"""
    all: Annotated[bool, Arg(exclusive="which!")] = False
    """all six, one joint after the other"""
    axis: Annotated[str | None, Arg(choices=AXES)] = None
    """only this one (default: both)"""
    torque: Annotated[float, Range(1e-3, FINITE_MAX, "N m")] = 15.0
    """of the sines; what holds a leg that is bent for it comes on top"""
    apply: bool = False
    """write what changes into the robot file, after a backup of it"""
    out: Folder | None = None
    """where the picture goes (out/identify-<time>)"""

    def check(self) -> None:
        """Refuse unknown modules."""
        super().check()
        unknown = [name for name in self.module if name not in MODULES]
        if unknown:
            raise DriveError(f"{unknown[0][:40]}: one of {', '.join(MODULES)} is right")

    @property
    def modules(self) -> tuple[str, ...]:
        """The selected modules."""
        return self.module or MODULES

    @property
    def axes(self) -> tuple[int, ...]:
        """The selected axes."""
        return (0, 1) if self.axis is None else (AXES.index(self.axis),)


def run(flags: JointFlags, console: Console) -> int:
    """Measure the joints that are asked for; 0 if no motion was stopped."""
    if not flags.dry_run:
        require("plot")
    path = robot_file(flags)
    robot = config_file.load_without_schedule(path)
    if flags.apply:
        refuse_running(path)
    results: list[JointResult] = []
    stopped: Stopped | None = None
    interrupts = Interrupts()
    module_motion.refuse_services(robot, flags.modules, flags.run_dir)
    with drives_to_ourselves(
        robot, path, flags.run_dir, console.print, lifted=module_motion.LIFTED
    ):
        for joint in ((module, axis) for module in flags.modules for axis in flags.axes):
            try:
                found = _measure(flags, robot, joint, interrupts, console)
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
        picture = make_folder(flags.out, "identify") / "joints.png"
        report.draw_joints(estimates, results, picture)
        report.tell(estimates, robot, path if flags.apply else None, console)
        console.print(f"{picture}", style="dim")
    code = 0 if stopped is None else module_motion.tell_stopped(stopped, console)
    module_motion.exit_if_interrupted(interrupts)
    return code


def _measure(
    flags: JointFlags,
    robot: RobotConfig,
    joint: tuple[str, int],
    interrupts: Interrupts,
    console: Console,
) -> JointResult | Stopped | None:
    """Measure one joint; return its result, how it was stopped, or None for a dry run."""
    name = f"{joint[0]}_{AXES[joint[1]]}"

    def plan_of(q: Mapping[str, Pair]) -> SinePlan:
        plan = plan_for(
            joint[1], flags.torque, robot.joint.armature, hanging_joint(robot, q, *joint)
        )
        console.print(_described(name, plan))
        return plan

    moved = module_motion.ask_and_move(flags, robot, joint, plan_of, interrupts, console)
    if not isinstance(moved, module_motion.Moved):
        return moved
    fit = fit_sines(moved.samples, moved.plan)
    if fit is None:
        return Stopped(f"{name}: too few samples for a fit; see its bus (`xrl drive can test`)")
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
