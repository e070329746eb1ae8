"""`xrl drive jog`: move one joint a little and back, on the bench, and judge it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final

from rich import box
from rich.table import Table
from rich.text import Text

from shared.bus.messages import Pair
from shared.config import files as config_file
from shared.exceptions import FAULT_EXIT_CODE, DriveError
from shared.joints import AXES, MODULES
from shared.toml_file import Range
from tools.bringup import drive_access
from tools.bringup.jog import JogPlan, ThereAndBack, judge, what_to_see
from tools.bringup.module_motion import (
    Moved,
    Stopped,
    ask_and_move,
    exit_if_interrupted,
    tell_stopped,
)
from tools.bringup.motion import limit_drives
from tools.bringup.motion_runner import Interrupts
from tools.flags import Arg, MotionFlags, Number, positional
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
xrl drive jog knee_left --torque-limit 30     # if its load needs more
"""


class JogFlags(MotionFlags):
    """Which joint, and how it moves."""

    module: Annotated[str, positional("MODULE", choices=MODULES)]
    """which module"""
    axis: Annotated[str, Arg(choices=AXES)] = "theta"
    by: Annotated[float, Range(-BY_MAX, BY_MAX, "rad")] = BY
    """distance out and back; positive theta leans forward"""
    period: Annotated[float, Range(PERIOD_MIN_S, 60.0, "s")] = PERIOD_S
    """time of one motion out and back"""
    cycles: Annotated[int, Range(1, CYCLES_MAX, "")] = CYCLES
    torque_limit: Annotated[Number, Arg(metavar="NM")] = TORQUE_LIMIT
    """limit of both axes together at the joint, set as the drive's own current limit"""

    def check(self) -> None:
        """Refuse a motion that is none."""
        super().check()
        if self.by == 0.0:
            raise DriveError(f"--by 0: up to {BY_MAX:g} rad either way, and not 0, is right")

    @property
    def plan(self) -> JogPlan:
        """The requested motion."""
        course = ThereAndBack(self.by, self.period, self.cycles)
        return JogPlan(AXES.index(self.axis), course, self.torque_limit)


def run(flags: JogFlags) -> int:
    """Look, ask, move, idle, judge."""
    console = Console()
    plan = flags.plan
    path = drive_access.robot_file(flags)
    module: str = flags.module
    robot = config_file.load_without_schedule(path)
    limited = limit_drives(robot, plan)
    drive_access.refuse_service(robot, module, flags.run_dir)
    interrupts = Interrupts()

    def introduce(_q: Mapping[str, Pair]) -> JogPlan:
        by, period_s, cycles = plan.course
        console.print(
            f"{module} {flags.axis}: {by:+g} rad and back, {cycles} times in {period_s:g} s each, "
            f"with at most {plan.torque_limit:g} N m "
            f"({limited.drive.current_lim:.1f} A a motor, {limited.drive.vel_limit:.1f} turn/s)"
        )
        console.print(f"to see: {what_to_see(module, plan.axis, by)}")
        return plan

    with drive_access.drives_to_ourselves(robot, path, flags.run_dir, console.print) as started:
        if started:
            console.print(f"its soles rest on the floor: a leg needs --torque-limit {EMULATED:g}")
        moved = ask_and_move(
            flags, robot, (module, plan.axis), introduce, interrupts, console, alone=True
        )
    if moved is None:
        return 0
    if isinstance(moved, Stopped):
        code = tell_stopped(moved, console)
    else:
        code = report(moved, module, console)
    if not isinstance(moved, Stopped) or not (moved.declined or moved.not_idle):
        console.print("both axes are idle")
    exit_if_interrupted(interrupts)
    return code


def report(moved: Moved[ThereAndBack], module: str, console: Console) -> int:
    """Print the verdict; return 0 if the joint followed."""
    plan = moved.plan
    rows = judge(moved.samples, plan)
    table = Table("", "measured", "wanted", "", box=box.SIMPLE_HEAD)
    for row in rows:
        verdict = Text("ok") if row.good else Text("not good", "bold red")
        table.add_row(row.what, row.value, row.wanted, verdict if row.wanted else "")
    console.print(table)
    code = 0 if all(row.good for row in rows) else FAULT_EXIT_CODE
    words = "[bold red]DID NOT FOLLOW[/]" if code else "[bold green]FOLLOWED[/]"
    console.print(marked(f"{words}: {{}} {{}}", module, AXES[plan.axis]))
    console.print(
        f"correct only if you saw this: {what_to_see(module, plan.axis, plan.course.by)}; "
        "an encoder on the motor cannot tell"
    )
    return code
