"""`xrl drive identify`: measures a hanging joint's friction and its rotors' reflected inertia."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Final

from rich import box
from rich.table import Table
from rich.text import Text

from shared.bus.messages import Pair
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DriveError
from shared.joints import AXES, MODULES
from shared.toml_file import Range
from tools.bringup import motion_runner
from tools.bringup.drive_access import drives_to_ourselves, robot_file
from tools.bringup.hanging_leg import hanging_joint
from tools.bringup.identify import (
    Estimate,
    JointResult,
    SinePlan,
    estimates_of,
    fit_sines,
    plan_for,
)
from tools.bringup.motion_runner import Interrupts, Stopped, exit_if_interrupted
from tools.flags import FINITE_MAX, Arg, MotionFlags, positional
from tools.terminal import Console

EXAMPLES: Final = """
xrl drive identify ankle_left --dry-run          # hanging, the fleet down
xrl drive identify ankle_left ankle_right
xrl drive identify --all --axis theta
"""
STYLES: Final = {"change": "bold yellow", "agrees": "green", "measured": "", "not shown": "dim"}


class IdentifyFlags(MotionFlags):
    """Joints to measure, and their torque limit."""

    module: Annotated[tuple[str, ...], positional("MODULE", one_of="which")] = ()
    """module, such as knee_left"""
    all: Annotated[bool, Arg(one_of="which")] = False
    """all six modules"""
    axis: Annotated[str | None, Arg(choices=AXES)] = None
    """only this axis (default: both)"""
    torque: Annotated[float, Range(1e-3, FINITE_MAX, "N m")] = 15.0
    """torque limit, added to the torque against gravity; the sine motions scale with it"""

    def check(self) -> None:
        """Refuse unknown modules."""
        super().check()
        unknown = [name for name in self.module if name not in MODULES]
        if unknown:
            raise DriveError(f"{unknown[0][:40]}: must be one of {', '.join(MODULES)}")

    @property
    def modules(self) -> tuple[str, ...]:
        """The selected modules."""
        return self.module or MODULES

    @property
    def axes(self) -> tuple[int, ...]:
        """The selected axes."""
        return (0, 1) if self.axis is None else (AXES.index(self.axis),)


def run(flags: IdentifyFlags) -> int:
    """Measure the requested joints; return 0 if no motion was stopped."""
    console = Console()
    path = robot_file(flags)
    robot = config_file.load_without_schedule(path)
    results: list[JointResult] = []
    stopped: Stopped | None = None
    interrupts = Interrupts()
    motion_runner.refuse_services(robot, flags.modules, flags.run_dir)
    with drives_to_ourselves(
        robot, path, flags.run_dir, console.print, lifted=motion_runner.LIFTED
    ):
        for joint in ((module, axis) for module in flags.modules for axis in flags.axes):
            try:
                found = _measure(flags, robot, joint, interrupts, console)
            except DriveError as error:
                if not results:
                    raise
                found = Stopped(str(error))  # report the results so far
            if isinstance(found, Stopped):
                stopped = found
                break
            if found is not None:
                results.append(found)
    if results:
        report(estimates_of(results, robot), console)
    code = 0 if stopped is None else motion_runner.tell_stopped(stopped, console)
    exit_if_interrupted(interrupts)
    return code


def report(estimates: Sequence[Estimate], console: Console) -> None:
    """Print the estimates and, if the armature has to change, the line for the robot file."""
    table = Table(box=box.SIMPLE_HEAD, collapse_padding=True, pad_edge=False)  # in 80 columns
    table.add_column("")
    for heading in ("robot file", "measured", "95 %"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("", no_wrap=True)
    for row in estimates:
        digits = row.digits
        table.add_row(
            row.what,
            "" if row.file is None else f"{row.file:.{digits}f}",
            f"{row.value:.{digits}f}",
            f"± {row.half_width:.{digits}f}",
            row.unit,
            Text(row.verdict, STYLES[row.verdict]),
        )
    console.print(table)
    rotor = estimates[-1]
    if rotor.verdict == "change":
        console.print(
            f"write into the robot file, section [joint]: armature = {rotor.value:.{rotor.digits}f}"
            "; then run `xrl gains`, because the gain schedule depends on it"
        )
    if rotor.verdict != "not shown":
        console.print("joint.armature is measured now: remove it from `assumed`", style="dim")


def _measure(
    flags: IdentifyFlags,
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

    moved = motion_runner.ask_and_move(flags, robot, joint, plan_of, interrupts, console)
    if not isinstance(moved, motion_runner.Moved):
        return moved
    fit = fit_sines(moved.samples, moved.plan)
    if fit is None:
        return Stopped(f"{name}: too few samples for a fit; check its bus with `xrl doctor`")
    return JointResult(name, fit, hanging_joint(robot, moved.q, *joint).inertia)


def _described(joint: str, plan: SinePlan) -> str:
    tones = ", ".join(
        f"{1e3 * t.amplitude:.0f} mrad at {t.frequency_hz:g} Hz" for t in plan.course.tones
    )
    phi, theta = plan.bias
    led = f"; moved by {phi:+.2f}, {theta:+.2f} rad first" if any(plan.bias) else ""
    return (
        f"{joint}: {tones}, {plan.duration_s:.0f} s, at most {plan.torque_limit:.0f} N m{led}; the "
        "leg's other modules hold"
    )
