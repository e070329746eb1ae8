"""`xrl gains`: compute the certified gain schedule of a robot, or say whether it fits."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from shared import config_file, gain_schedule
from shared.config import RobotConfig
from shared.config_sections import GainSchedule
from shared.exceptions import ConfigError
from tools.verbs import Subparsers, add_config, add_verb

SHOWN = 6
"""Heights in the printed table."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "gains",
        """
        xrl gains
        xrl gains --config lab.toml
        xrl gains --config lab.toml --damping-of deploy/robot.gains.json
        xrl gains --check
        """,
    )
    add_config(parser)
    parser.add_argument(
        "--damping-of",
        type=Path,
        metavar="FILE",
        help="take damping and coupling from another schedule, such as deploy/robot.gains.json, "
        "and hold them to the dynamic certificate; without it they are searched for (two minutes)",
    )
    parser.add_argument(
        "--check", action="store_true", help="only say whether the schedule fits the robot"
    )


def run(args: argparse.Namespace) -> int:
    """Write the schedule beside the robot file; with --check 1 if it would have to be."""
    path = gain_schedule.path_beside(args.config)
    console = Console()
    if args.check:
        stale = gain_schedule.why_stale(config_file.load(args.config))
        console.print(f"{path}: {stale or 'fits the robot'}", soft_wrap=True)
        return 1 if stale else 0
    robot = config_file.load_without_schedule(args.config)
    schedule = compute(robot, console, args.damping_of)
    gain_schedule.write(path, schedule)
    _show(robot, schedule, console)
    console.print(f"written to {path}", style="dim", soft_wrap=True)
    return 0


def compute(robot: RobotConfig, console: Console, damping_of: Path | None = None) -> GainSchedule:
    """Solve the schedule with a progress bar.

    Args:
        robot: the robot.
        console: to print on.
        damping_of: schedule to take damping and coupling from; None: they are searched for.

    Raises:
        RunError: no local gains meet the certificate somewhere.
    """
    from services.planner import split_program  # noqa: PLC0415 - cvxpy takes a second to load

    design = None
    if damping_of is not None:
        other = gain_schedule.read(damping_of)
        if other is None:
            raise ConfigError(str(damping_of), "(file)", "not found", "a schedule by `xrl gains`")
        design = split_program.design_of(other)
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
        console=console, transient=True,
    )  # fmt: skip
    with bar as progress:
        task = progress.add_task("poses of the gain schedule", total=None)
        search = progress.add_task("", total=None, visible=False)
        return split_program.solve(
            robot,
            lambda done, total: progress.update(task, completed=done, total=total),
            lambda text: progress.update(search, description=text, visible=True),
            design,
        )


def _show(robot: RobotConfig, schedule: GainSchedule, console: Console) -> None:
    from services.planner import split_program  # noqa: PLC0415 - cvxpy takes a second to load

    table = Table(title="Local stiffness D of each leg, torso upright, N m/rad")
    table.add_column("COM m", justify="right")
    for kind in ("ankle", "knee", "hip"):
        for axis in ("phi", "theta"):
            table.add_column(f"{kind}\n{axis}", justify="right")
    upright = min(range(len(schedule.pitch)), key=lambda j: abs(schedule.pitch[j]))
    step = (len(schedule.z) - 1) / (SHOWN - 1)
    for i in (round(n * step) for n in range(SHOWN)):
        row = schedule.D[i][upright]
        table.add_row(f"{schedule.z[i]:.3f}", *(f"{value:.0f}" for value in row))
    console.print(table)
    margins = split_program.smallest_margins(robot, schedule)
    console.print(
        f"smallest margin, nodes and half way between: {margins.service:.2f} of what is "
        f"required with the joint services alone, {margins.onboard:.2f} with the drives alone"
    )
