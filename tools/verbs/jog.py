"""`xrl jog`: move one joint a little and back, on the bench, and judge it."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Final

from rich import box
from rich.table import Table
from rich.text import Text

from shared.bus.messages import Pair
from shared.config import files as config_file
from shared.exceptions import FAULT_EXIT_CODE, DriveError
from shared.joints import AXES, MODULES
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
from tools.number_arguments import count, finite
from tools.terminal import Console, marked
from tools.verb_table import FLEET, Subparsers, add_config, add_run_dir, add_verb

BY: Final = 0.05
PERIOD_S: Final = 2.0
CYCLES: Final = 2
TORQUE_LIMIT: Final = 10.0
EMULATED: Final = 40.0
"""N m that bend a leg of the emulated robot, which hangs with its soles on the floor."""
BY_MAX: Final = 0.5
PERIOD_MIN_S: Final = 0.5
CYCLES_MAX: Final = 100


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "jog",
        """
        xrl jog knee_left
        xrl jog hip_right --axis phi --by -0.1 --period 4
        xrl jog knee_left --torque-limit 30     # where its load needs more
        """,
    )
    parser.add_argument("module", choices=MODULES, metavar="MODULE", help="which module")
    parser.add_argument("--axis", choices=AXES, default="theta", help="default: %(default)s")
    parser.add_argument(
        "--by",
        type=finite,
        default=BY,
        metavar="RAD",
        help="how far, and back; positive theta leans forward (default: %(default)s)",
    )
    parser.add_argument(
        "--period",
        type=finite,
        default=PERIOD_S,
        metavar="S",
        help="time of one there and back (default: %(default)s)",
    )
    parser.add_argument(
        "--cycles", type=count, default=CYCLES, metavar="N", help="default: %(default)s"
    )
    parser.add_argument(
        "--torque-limit",
        type=finite,
        default=TORQUE_LIMIT,
        metavar="NM",
        help="of both axes together at the joint; the drive's own current limit is set to it "
        "(default: %(default)s)",
    )
    parser.add_argument("--yes", action="store_true", help="do not ask")
    add_config(parser, before=FLEET)
    add_run_dir(parser)


def run(args: argparse.Namespace) -> int:
    """Look, ask, move, idle, judge."""
    console = Console()
    plan = plan_of(args)
    path = drive_access.robot_file(args)
    module: str = args.module
    robot = config_file.load_without_schedule(path)
    limited = limit_drives(robot, plan)
    drive_access.refuse_service(robot, module, args.run_dir)
    interrupts = Interrupts()

    def introduce(_q: Mapping[str, Pair]) -> JogPlan:
        by, period_s, cycles = plan.course
        console.print(
            f"{module} {args.axis}: {by:+g} rad and back, {cycles} times in {period_s:g} s each, "
            f"with at most {plan.torque_limit:g} N m "
            f"({limited.drive.current_lim:.1f} A a motor, {limited.drive.vel_limit:.1f} turn/s)"
        )
        console.print(f"to see: {what_to_see(module, plan.axis, by)}")
        return plan

    with drive_access.drives_to_ourselves(robot, path, args.run_dir, console.print) as started:
        if started:
            console.print(f"its soles rest on the floor: a leg needs --torque-limit {EMULATED:g}")
        moved = ask_and_move(
            args, robot, (module, plan.axis), introduce, interrupts, console, alone=True
        )
    if isinstance(moved, Stopped):
        code = tell_stopped(moved, console)
    else:
        assert moved is not None  # noqa: S101 - a jog has no dry run
        code = report(moved, module, console)
    if not isinstance(moved, Stopped) or not (moved.declined or moved.not_idle):
        console.print("both axes are idle")
    exit_if_interrupted(interrupts)
    return code


def plan_of(args: argparse.Namespace) -> JogPlan:
    """Return the requested motion.

    Raises:
        DriveError: it is out of range.
    """
    if not 0.0 < abs(args.by) <= BY_MAX:
        raise DriveError(f"--by {args.by:g}: up to {BY_MAX:g} rad either way, and not 0, is right")
    if not PERIOD_MIN_S <= args.period <= 60.0:
        raise DriveError(f"--period {args.period:g}: {PERIOD_MIN_S:g} .. 60 s is right")
    if not 1 <= args.cycles <= CYCLES_MAX:
        raise DriveError(f"--cycles {args.cycles}: 1 .. {CYCLES_MAX} is right")
    course = ThereAndBack(args.by, args.period, args.cycles)
    return JogPlan(AXES.index(args.axis), course, args.torque_limit)


def report(moved: Moved[ThereAndBack], module: str, console: Console) -> int:
    """Print the verdict; return 0 if the joint followed."""
    plan = moved.plan
    rows = judge(moved.samples, plan)
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
        f"right only if you saw this: {what_to_see(module, plan.axis, plan.course.by)}; "
        "an encoder on the motor cannot tell"
    )
    return code
