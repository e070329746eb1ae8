"""`xrl drive jog`: move one joint a little and back, on the bench, and judge it."""

from __future__ import annotations

import sys
from typing import Annotated, Final

from rich import box
from rich.table import Table
from rich.text import Text

from services.joint.__main__ import open_drive
from services.joint.differential import joint_from_motor
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError
from shared.joints import AXES, MODULES
from shared.toml_file import Range
from tools.bringup import bench, limits
from tools.bringup.jog_drive import NOT_IDLE, Interrupts, JogResult, first_reading, jog_drive
from tools.bringup.jogging import JogPlan, Sample, gentle, judge, outside, what_to_see
from tools.flags import Arg, FleetRobotFlags, Number, positional
from tools.terminal import Console, marked

BY: Final = 0.05
PERIOD_S: Final = 2.0
CYCLES: Final = 2
TORQUE_LIMIT: Final = 10.0
EMULATED: Final = 40.0
"""N m that bend a leg of the emulated robot, which hangs with its soles on the floor."""
BY_MAX: Final = 0.5
PERIOD_MIN_S: Final = 0.5
CYCLES_MAX: Final = 100


EXAMPLES: Final = """
xrl drive jog knee_left
xrl drive jog hip_right --axis phi --by -0.1 --period 4
xrl drive jog knee_left --torque-limit 30     # where its load needs more
"""


class JogFlags(FleetRobotFlags):
    """Which joint, and how it moves."""

    module: Annotated[str, positional("MODULE", choices=MODULES)]
    """which module"""
    axis: Annotated[str, Arg(choices=AXES)] = "theta"
    by: Annotated[float, Range(-BY_MAX, BY_MAX, "rad")] = BY
    """how far, and back; positive theta leans forward"""
    period: Annotated[float, Range(PERIOD_MIN_S, 60.0, "s")] = PERIOD_S
    """time of one there and back"""
    cycles: Annotated[int, Range(1, CYCLES_MAX, "")] = CYCLES
    torque_limit: Annotated[Number, Arg(metavar="NM")] = TORQUE_LIMIT
    """of both axes together at the joint; the drive's own current limit is set to it"""
    yes: bool = False
    """do not ask"""

    def check(self) -> None:
        """Refuse a motion that is none."""
        super().check()
        if self.by == 0.0:
            raise DriveError(f"--by 0: up to {BY_MAX:g} rad either way, and not 0, is right")

    @property
    def plan(self) -> JogPlan:
        """The requested motion."""
        return JogPlan(AXES.index(self.axis), self.by, self.period, self.cycles, self.torque_limit)


def run(flags: JogFlags) -> int:
    """Look, ask, move, idle, judge."""
    console = Console()
    plan = flags.plan
    path = bench.robot_file(flags)
    module = flags.module
    robot = config_file.load_without_schedule(path)
    limited = gentle(robot, plan)
    bench.refuse_service(robot, flags.module, flags.run_dir)
    interrupts = Interrupts()
    with bench.drives_to_ourselves(robot, path, flags.run_dir, console.print) as started:
        if started:
            console.print(f"its soles rest on the floor: a leg needs --torque-limit {EMULATED:g}")
        outcome = confirm_and_move(flags, console, limited, plan, interrupts)
        if outcome is None:
            console.print("nothing was moved")
            return DECLINED_EXIT_CODE
        why = limits.not_given_back(robot, flags.module, flags.run_dir) if outcome.is_idle else ""
        if why:
            console.print(marked("[yellow]{}[/]", why))
    code = report(outcome, module, plan, console)
    if interrupts.number:
        sys.exit(128 + interrupts.number)
    return code


def confirm_and_move(
    flags: JogFlags,
    console: Console,
    robot: RobotConfig,
    plan: JogPlan,
    interrupts: Interrupts,
) -> JogResult | None:
    """Open the drive, look at the joint, ask, and move it; None if the answer was no.

    Args:
        flags: of the verb.
        console: to speak on.
        robot: as `gentle` made it.
        plan: what to do.
        interrupts: kept while the drive may be armed.

    Raises:
        DriveError: the drive does not answer, or the joint may not go there.
        FleetError: a joint service has the drive.
    """
    module = flags.module
    drive = open_drive(robot, module, flags.run_dir)
    try:
        try:
            reading = first_reading(drive)
        except DriveError as error:
            raise DriveError(f"{module}: {error}") from None
        q = joint_from_motor(reading.pos_turns, robot.joint.gear_ratio)
        if why := outside(robot, module, plan, q):
            raise DriveError(f"{module}: {why}")
        _introduce(robot, module, plan, console)
        if not bench.confirm("Is the joint free, and the power switch at hand?", yes=flags.yes):
            return None
        bench.refuse_service(
            robot, flags.module, flags.run_dir
        )  # a person may take minutes to answer
        with interrupts.kept():
            return jog_drive(
                drive,
                robot,
                module,
                plan,
                q_seen=q,
                interrupts=interrupts,
                progress=lambda sample: console.print(progress(sample, plan)),
            )
    finally:
        drive.close()


def progress(sample: Sample, plan: JogPlan) -> str:
    """Return a line on a sample."""
    axis = plan.axis
    return (
        f"{sample.t_s:6.2f} s  {AXES[axis]} asked {sample.q_ref[axis]:+.4f}, "
        f"is {sample.q[axis]:+.4f} rad, torque {sample.tau[axis]:+6.2f} N m"
    )


def report(outcome: JogResult, module: str, plan: JogPlan, console: Console) -> int:
    """Print how it went; return 0 if the joint followed."""
    code = FAULT_EXIT_CODE
    if outcome.trouble:
        console.print(marked("[bold red]STOPPED[/]: {}", outcome.trouble))
    else:
        rows = judge(outcome.samples, plan)
        table = Table(box=box.SIMPLE_HEAD)
        for heading in ("", "measured", "wanted", ""):
            table.add_column(heading)
        for row in rows:
            verdict = Text("ok") if row.good else Text("not good", "bold red")
            table.add_row(row.what, row.value, row.wanted, verdict if row.wanted else "")
        console.print(table)
        code = 0 if all(row.good for row in rows) else FAULT_EXIT_CODE
        words = "[bold red]DID NOT FOLLOW[/]" if code else "[bold green]FOLLOWED[/]"
        console.print(marked(f"{words}: {{}} {{}}", module, AXES[plan.axis]))
        console.print(
            f"right only if you saw this: {what_to_see(module, plan.axis, plan.by)}; "
            "an encoder on the motor cannot tell"
        )
    if outcome.is_idle:
        console.print("both axes are idle")
        return code
    console.print(marked("[bold red]{}[/]", NOT_IDLE))
    return FAULT_EXIT_CODE


def _introduce(robot: RobotConfig, module: str, plan: JogPlan, console: Console) -> None:
    """Print what is about to move."""
    console.print(
        f"{module} {AXES[plan.axis]}: {plan.by:+g} rad and back, {plan.cycles} times in "
        f"{plan.period_s:g} s each, with at most {plan.torque_limit:g} N m "
        f"({robot.drive.current_lim:.1f} A a motor, {robot.drive.vel_limit:.1f} turn/s)"
    )
    console.print(f"to see: {what_to_see(module, plan.axis, plan.by)}")
