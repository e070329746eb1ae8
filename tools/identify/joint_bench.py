"""`xrl identify joint`: looks at a hanging leg, asks, moves its joints one by one, and tells."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, Generic, NamedTuple, TypeVar

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.text import Text

from services.joint.__main__ import open_drive
from services.joint.drivers.base import Drive
from shared.clock import now_ns
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError, FleetError, XrlError
from shared.robot.joints import AXES, MODULES
from tools.bringup import bench, jog_drive, limits
from tools.bringup.jogging import MotionPlan, Sample, outside
from tools.identify import joint_drive, report
from tools.identify.estimates import JointResult, changes, measured, of_joints
from tools.identify.sines import SinePlan, fit_sines
from tools.output import make_folder

P = TypeVar("P", bound=MotionPlan)
LIFTED: Final = 0.2
"""m; the emulated robot is hung this much higher, feet clear of the floor."""


def run(args: argparse.Namespace, console: Console) -> int:
    """Measure the joints that are asked for; 1 if a motion was stopped."""
    modules, axes = _asked(args)
    path = bench.robot_file(args)
    robot = config_file.load_without_schedule(path)
    results: list[JointResult] = []
    trouble = ""
    interrupts = jog_drive.Interrupts()
    refuse_services(robot, modules, args.run_dir)
    with bench.drives_to_ourselves(robot, path, args.run_dir, console.print, lifted=LIFTED):
        for module in modules:
            for axis in axes:
                found = _joint(args, robot, module, axis, interrupts, console)
                if isinstance(found, str):
                    trouble = found
                    break
                if found is not None:
                    results.append(found)
            if trouble:
                break
    if interrupts.number:
        sys.exit(128 + interrupts.number)
    if trouble:
        console.print(f"[bold red]STOPPED[/]: {escape(trouble)}")
    if results:
        _tell(args, robot, path, results, console)
    return 1 if trouble else 0


def _asked(args: argparse.Namespace) -> tuple[Sequence[str], Sequence[int]]:
    """Return modules and axes.

    Raises:
        DriveError: they name none, or no such module.
    """
    unknown = [name for name in args.module if name not in MODULES]
    if unknown:
        raise DriveError(f"{unknown[0][:40]}: one of {', '.join(MODULES)} is right")
    if bool(args.module) == args.all:
        raise DriveError("name modules, or --all")
    axes = (0, 1) if args.axis is None else (AXES.index(args.axis),)
    return (MODULES if args.all else args.module), axes


def refuse_services(robot: RobotConfig, modules: Sequence[str], run_dir: Path) -> None:
    """Refuse legs that have a joint service up: a drive has one master.

    Raises:
        FleetError: naming the first.
    """
    for module in dict.fromkeys(name for one in modules for name in joint_drive.leg_of(one)):
        fleet = bench.service_on(robot, module, run_dir)
        if fleet is not None:
            raise FleetError(
                f"{module}: its joint service in {fleet.run.path} has the drive; hang the robot "
                f"and `xrl down --run-dir {fleet.run.path}` first"
            )


def _joint(
    args: argparse.Namespace,
    robot: RobotConfig,
    module: str,
    axis: int,
    interrupts: jog_drive.Interrupts,
    console: Console,
) -> JointResult | str | None:
    """Measure one joint; return its result, why it was stopped, or None for a dry run."""
    joint = f"{module}_{AXES[axis]}"

    def plan_of(where: joint_drive.Hanging) -> SinePlan:
        plan = joint_drive.plan_at(robot, module, axis, args.torque, where)
        console.print(_described(joint, plan))
        return plan

    moved = move_joint(args, robot, (module, axis), plan_of, interrupts, console)
    if not isinstance(moved, Moved):
        return moved
    fit = fit_sines(moved.samples, moved.plan)
    if fit is None:
        return f"{joint}: too few samples came for a fit; look at its bus (`xrl can test`)"
    return JointResult(joint, fit, moved.where.inertia)


class Moved(NamedTuple, Generic[P]):
    """A joint that was moved to the end of its plan."""

    samples: list[Sample]
    plan: P
    where: joint_drive.Hanging
    """The leg hung before."""


def move_joint(
    args: argparse.Namespace,
    robot: RobotConfig,
    joint: tuple[str, int],
    plan_of: Callable[[joint_drive.Hanging], P],
    interrupts: jog_drive.Interrupts,
    console: Console,
) -> Moved[P] | str | None:
    """Look at a leg, ask, and move a joint; return why it was stopped, or None for a dry run.

    Args:
        args: of the verb: `dry_run`, `yes`, `run_dir`.
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
        _open(robot, leg, args.run_dir) as drives,
        interrupts.kept(),
        console.status("waiting until the leg hangs still"),
    ):
        q = joint_drive.wait_until_still(drives, robot, interrupts, now_ns)
    if q is None:
        return "stopped before anything moved"
    where = joint_drive.hanging(robot, q, module, axis)
    plan = plan_of(where)
    limited = joint_drive.limited(robot, plan)
    if why := outside(joint_drive.within_stops(robot), module, plan, q[module]):
        raise DriveError(f"{module}: {why}")
    if args.dry_run:
        return None
    question = "Does the leg hang free, the power switch at hand?"
    if not bench.confirm(question, yes=args.yes):
        return "nothing was moved"
    refuse_services(robot, [module], args.run_dir)
    try:
        with (
            _open(limited, leg, args.run_dir) as drives,
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
    finally:
        _give_limits_back(robot, leg, args.run_dir, console)
    if not result.is_idle:
        return f"{module}: {jog_drive.NOT_IDLE}"
    if result.trouble:
        return f"{name}: {result.trouble}"
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
        try:
            limits.give_back(robot, module, run_dir)
        except XrlError as error:
            console.print(
                f"[yellow]{module}: the drive still has the limits of this motion "
                f"({escape(str(error))}) until it is armed by its service or restarted[/]"
            )


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
    args: argparse.Namespace,
    robot: RobotConfig,
    path: Path,
    results: Sequence[JointResult],
    console: Console,
) -> None:
    estimates = of_joints(results, robot)
    folder = make_folder(args.out, "identify")
    from tools.identify.picture import draw_joints  # noqa: PLC0415 - takes a second

    picture = folder / "joints.png"
    draw_joints(estimates, results, picture)
    console.print(report.estimates_table(estimates))
    values, known = changes(estimates, robot), measured(estimates)
    report.propose(values, known, console)
    if args.apply:
        report.write(path, values, known, console)
    console.print(f"{picture}", style="dim")
