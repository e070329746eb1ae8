"""`xrl drive jog`: move one joint a little and back, on the bench, and judge it."""

from __future__ import annotations

import argparse
import sys
from typing import Final

from rich import box
from rich.table import Table
from rich.text import Text

from services.joint.__main__ import open_drive
from services.joint.differential import joint_from_motor
from shared.config import files as config_file
from shared.config.robot_config import RobotConfig
from shared.exceptions import DECLINED_EXIT_CODE, FAULT_EXIT_CODE, DriveError
from shared.joints import AXES, MODULES
from tools.bringup import bench, limits
from tools.bringup.jog_drive import NOT_IDLE, Interrupts, JogResult, first_reading, jog_drive
from tools.bringup.jogging import JogPlan, Sample, gentle, judge, outside, what_to_see
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
        xrl drive jog knee_left
        xrl drive jog hip_right --axis phi --by -0.1 --period 4
        xrl drive jog knee_left --torque-limit 30     # where its load needs more
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
    path = bench.robot_file(args)
    module: str = args.module
    robot = config_file.load_without_schedule(path)
    limited = gentle(robot, plan)
    bench.refuse_service(robot, args.module, args.run_dir)
    interrupts = Interrupts()
    with bench.drives_to_ourselves(robot, path, args.run_dir, console.print) as started:
        if started:
            console.print(f"its soles rest on the floor: a leg needs --torque-limit {EMULATED:g}")
        outcome = confirm_and_move(args, console, limited, plan, interrupts)
        if outcome is None:
            console.print("nothing was moved")
            return DECLINED_EXIT_CODE
        why = limits.not_given_back(robot, args.module, args.run_dir) if outcome.is_idle else ""
        if why:
            console.print(marked("[yellow]{}[/]", why))
    code = report(outcome, module, plan, console)
    if interrupts.number:
        sys.exit(128 + interrupts.number)
    return code


def confirm_and_move(
    args: argparse.Namespace,
    console: Console,
    robot: RobotConfig,
    plan: JogPlan,
    interrupts: Interrupts,
) -> JogResult | None:
    """Open the drive, look at the joint, ask, and move it; None if the answer was no.

    Args:
        args: of the verb.
        console: to speak on.
        robot: as `gentle` made it.
        plan: what to do.
        interrupts: kept while the drive may be armed.

    Raises:
        DriveError: the drive does not answer, or the joint may not go there.
        FleetError: a joint service has the drive.
    """
    module: str = args.module
    drive = open_drive(robot, module, args.run_dir)
    try:
        try:
            reading = first_reading(drive)
        except DriveError as error:
            raise DriveError(f"{module}: {error}") from None
        q = joint_from_motor(reading.pos_turns, robot.joint.gear_ratio)
        if why := outside(robot, module, plan, q):
            raise DriveError(f"{module}: {why}")
        _introduce(robot, module, plan, console)
        if not bench.confirm("Is the joint free, and the power switch at hand?", yes=args.yes):
            return None
        bench.refuse_service(
            robot, args.module, args.run_dir
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
    return JogPlan(AXES.index(args.axis), args.by, args.period, args.cycles, args.torque_limit)


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
