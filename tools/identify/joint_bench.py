"""`xrl drive identify joint`: looks at a hanging leg, asks, moves joints one by one, tells."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Final, Generic, NamedTuple, TypeVar

from rich.live import Live
from rich.text import Text

from services.joint.__main__ import open_drive
from services.joint.drivers.base import Drive
from shared.clock import now_ns
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError
from shared.extras import require
from shared.joints import AXES, MODULES
from shared.toml_file import Range
from tools.bringup import bench, jog_drive, limits
from tools.bringup.jogging import MotionPlan, Sample, outside
from tools.bringup.stops import within_stops
from tools.flags import FINITE_MAX, Arg, Folder, MotionFlags, positional
from tools.identify import joint_drive, report
from tools.identify.estimates import JointResult, of_joints
from tools.identify.picture import draw_joints
from tools.identify.sines import SinePlan, fit_sines
from tools.output import make_folder
from tools.terminal import Console, marked

P = TypeVar("P", bound=MotionPlan)
LIFTED: Final = 0.2
"""m; the emulated robot is hung this much higher, feet clear of the floor."""


class Moved(NamedTuple, Generic[P]):
    """A joint that was moved to the end of its plan."""

    samples: list[Sample]
    plan: P
    where: joint_drive.Hanging
    """How the leg hung before."""


class Stopped(NamedTuple):
    """A motion that did not come to its end, or did not begin."""

    why: str
    not_idle: tuple[str, ...] = ()
    """Modules whose drives do not say that they are idle."""
    declined: bool = False
    """The person said no."""


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
        """Refuse what is no module."""
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
    path = bench.robot_file(flags)
    robot = config_file.load_without_schedule(path)
    if flags.apply:
        report.refuse_running(path)
    results: list[JointResult] = []
    stopped: Stopped | None = None
    interrupts = jog_drive.Interrupts()
    refuse_services(robot, flags.modules, flags.run_dir)
    with bench.drives_to_ourselves(robot, path, flags.run_dir, console.print, lifted=LIFTED):
        for module, axis in ((module, axis) for module in flags.modules for axis in flags.axes):
            try:
                found = _joint(flags, robot, module, axis, interrupts, console)
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
        _tell(flags, robot, path, results, console)
    code = 0 if stopped is None else tell_stopped(stopped, console)
    if interrupts.number:
        sys.exit(128 + interrupts.number)
    return code


def tell_stopped(stopped: Stopped, console: Console) -> int:
    """Print why a motion ended, a danger last; return the exit code."""
    if stopped.declined:
        console.print(stopped.why)
        return DECLINED_EXIT_CODE
    console.print(marked("[bold red]STOPPED[/]: {}", stopped.why))
    for module in stopped.not_idle:
        console.print(marked("[bold red]{}: {}[/]", module, jog_drive.NOT_IDLE))
    return FAULT_EXIT_CODE


def refuse_services(robot: RobotConfig, modules: Sequence[str], run_dir: Path) -> None:
    """Refuse if the leg of one of these modules has a joint service up.

    Raises:
        FleetError: naming the first.
    """
    legs = dict.fromkeys(name for one in modules for name in joint_drive.leg_of(one))
    for name in legs:
        bench.refuse_service(robot, name, run_dir)


def _joint(
    flags: JointFlags,
    robot: RobotConfig,
    module: str,
    axis: int,
    interrupts: jog_drive.Interrupts,
    console: Console,
) -> JointResult | Stopped | None:
    """Measure one joint; return its result, how it was stopped, or None for a dry run."""
    joint = f"{module}_{AXES[axis]}"

    def plan_of(where: joint_drive.Hanging) -> SinePlan:
        plan = joint_drive.plan_at(robot, module, axis, flags.torque, where)
        console.print(_described(joint, plan))
        return plan

    moved = move_joint(flags, robot, (module, axis), plan_of, interrupts, console)
    if not isinstance(moved, Moved):
        return moved
    fit = fit_sines(moved.samples, moved.plan)
    if fit is None:
        return Stopped(f"{joint}: too few samples for a fit; see its bus (`xrl drive can test`)")
    return JointResult(joint, fit, moved.where.inertia)


def move_joint(
    flags: MotionFlags,
    robot: RobotConfig,
    joint: tuple[str, int],
    plan_of: Callable[[joint_drive.Hanging], P],
    interrupts: jog_drive.Interrupts,
    console: Console,
) -> Moved[P] | Stopped | None:
    """Look at a leg, ask, and move a joint; return how it ended, or None for a dry run.

    Args:
        flags: of the verb: `dry_run`, `yes`, `run_dir`.
        robot: its file.
        joint: module and axis.
        plan_of: returns the motion of a leg that hangs so, and tells of it.
        interrupts: kept while drives may be armed.
        console: to speak on.

    Raises:
        DriveError: a drive of the leg does not answer, or the joint may not go there.
        FleetError: nobody is there to ask, or a service has a drive.
    """
    module, axis = joint
    name = f"{module}_{AXES[axis]}"
    leg = joint_drive.leg_of(module)
    with (
        _open(robot, leg, flags.run_dir) as drives,
        interrupts.kept(),
        console.status("waiting until the leg hangs still"),
    ):
        q = joint_drive.wait_until_still(drives, robot, interrupts, now_ns)
    if q is None:
        return Stopped("nothing was moved yet")
    where = joint_drive.hanging(robot, q, module, axis)
    plan = plan_of(where)
    limited = joint_drive.limited(robot, plan)
    if why := outside(within_stops(robot), module, plan, q[module]):
        raise DriveError(f"{module}: {why}")
    if flags.dry_run:
        return None
    question = "Does the leg hang free, the power switch at hand?"
    if not bench.confirm(question, yes=flags.yes):
        return Stopped("nothing was moved", declined=True)
    refuse_services(robot, [module], flags.run_dir)
    with (
        _open(limited, leg, flags.run_dir) as drives,
        interrupts.kept(),
        Live(console=console, refresh_per_second=4, transient=True) as shown,
    ):
        result = joint_drive.move(
            drives,
            limited,
            module,
            plan,
            q_seen=q,
            interrupts=interrupts,
            progress=lambda sample: shown.update(_line(sample, plan, name)),
            clock=now_ns,
        )
    # only to drives that say that they are idle: full limits are nothing for an armed one
    idle = [one for one in leg if one not in result.not_idle]
    _give_limits_back(robot, idle, flags.run_dir, console)
    if result.trouble or result.not_idle:
        return Stopped(f"{name}: {result.trouble or 'the motion ended'}", result.not_idle)
    return Moved(result.samples, plan, where)


@contextlib.contextmanager
def _open(robot: RobotConfig, modules: Sequence[str], run_dir: Path) -> Iterator[dict[str, Drive]]:
    with contextlib.ExitStack() as stack:
        drives = {}
        for name in modules:
            drives[name] = open_drive(robot, name, run_dir)
            stack.callback(drives[name].close)
        yield drives


def _give_limits_back(
    robot: RobotConfig, modules: Sequence[str], run_dir: Path, console: Console
) -> None:
    for module in modules:
        if why := limits.not_given_back(robot, module, run_dir):
            console.print(marked("[yellow]{}: {}[/]", module, why))


def _described(joint: str, plan: SinePlan) -> str:
    tones = ", ".join(f"{1e3 * t.amplitude:.0f} mrad at {t.frequency_hz:g} Hz" for t in plan.tones)
    phi, theta = plan.bias
    led = f"; led by {phi:+.2f}, {theta:+.2f} rad first" if any(plan.bias) else ""
    return (
        f"{joint}: {tones}, {plan.duration_s:.0f} s, at most {plan.torque_limit:.0f} N m{led}; the "
        "leg's other modules hold"
    )


def _line(sample: Sample, plan: MotionPlan, joint: str) -> Text:
    return Text(
        f"{joint}  {sample.t_s:5.1f} of {plan.duration_s:.0f} s  "
        f"{sample.q[plan.axis]:+.4f} rad, {sample.tau[plan.axis]:+6.2f} N m"
    )


def _tell(
    flags: JointFlags,
    robot: RobotConfig,
    path: Path,
    results: Sequence[JointResult],
    console: Console,
) -> None:
    estimates = of_joints(results, robot)
    folder = make_folder(flags.out, "identify")
    picture = folder / "joints.png"
    draw_joints(estimates, results, picture)
    report.tell(estimates, robot, path if flags.apply else None, console)
    console.print(f"{picture}", style="dim")
