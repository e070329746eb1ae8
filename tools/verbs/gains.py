"""`xrl gains`: computes the certified gain schedule of a robot, or checks whether it fits."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Final

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from shared.config import files as config_file
from shared.config import gain_schedule
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, ConfigError
from shared.extras import require
from shared.places import refuse_shipped
from tools.flags import Arg, ConfigFlags, option
from tools.lab.design import split_program
from tools.lab.design.body_stiffness import BodyStiffness, for_robot
from tools.lab.design.dynamic_certificate import (
    BLIND,
    BLIND_S,
    HELD,
    PARKED,
    TRACK,
    DynamicCertificate,
)
from tools.terminal import Console

ROOM_EVERY = 5
"""The printed dynamic figures are computed at every n-th pose."""
SHOWN = 6
"""Number of heights in the printed table."""


STIFFNESS_ROWS = (
    ("theta_max", "rad", "largest lean the ankles' torque can hold"),
    ("theta_edge", "rad", "lean with the COM over the sole's edge"),
    ("tau_edge", "N m", "torque of each ankle at that lean"),
    ("K_ank_min", "N m/rad", "minimum stiffness of each ankle"),
    ("K_min", "N/m", "minimum stiffness of the body"),
    ("K_tau_max", "N/m", "stiffness that gives tau_max at the edge"),
)

EXAMPLES: Final = """
xrl gains
xrl gains --config lab.toml --damping-of deploy/robot.gains.json
xrl gains --check
"""


class _GainsFlags(ConfigFlags):
    """Robot of the schedule, and whether to compute or check it."""

    damping_of: Path | None = None
    """take damping and coupling from this schedule, such as deploy/robot.gains.json, and check them
    with the dynamic certificate (default: search for them, which takes two minutes)"""
    check_only: Annotated[bool, option("--check", exclusive="only")] = False
    """only check whether the schedule fits the robot"""
    stiffness: Annotated[bool, Arg(exclusive="only")] = False
    """only print the stiffness that balance requires (paper section IV)"""


def run(flags: _GainsFlags) -> int:
    """Write the schedule beside the robot file; with --check, only check the existing schedule."""
    robot = config_file.load_without_schedule(flags.config)
    if flags.stiffness:
        return _show_stiffness(robot)
    path = gain_schedule.path_beside(flags.config)
    console = Console()
    if flags.check_only:
        stale = gain_schedule.why_stale(config_file.load(flags.config))
        console.print(f"{path}: {stale or 'fits the robot'}", soft_wrap=True)
        return FAULT_EXIT_CODE if stale else 0
    refuse_shipped(path)
    require("design")
    schedule = compute(robot, console, flags.damping_of)
    gain_schedule.write(path, schedule)
    _show(robot, schedule, console)
    console.print(f"written to {path}", style="dim", soft_wrap=True)
    return 0


def compute(robot: RobotConfig, console: Console, damping_of: Path | None = None) -> GainSchedule:
    """Compute the schedule; search for damping and coupling, or take them from another."""
    design = None
    if damping_of is not None:
        other = gain_schedule.read(damping_of)
        if other is None:
            raise ConfigError(
                str(damping_of), "(file)", "not found", "give a schedule from `xrl gains`"
            )
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
    _show_damping(robot, schedule, console)
    margins = split_program.smallest_margins(robot, schedule)
    console.print(
        "smallest margin at the nodes and halfway between them (1 is the required "
        f"stiffness): {margins.service:.2f} with the joint services alone, "
        f"{margins.onboard:.2f} with the drives alone"
    )


def _show_damping(robot: RobotConfig, schedule: GainSchedule, console: Console) -> None:
    """Print the design chosen with the dynamic certificate, and its least stable condition."""
    D_B = ", ".join(f"{value:.1f}" for value in schedule.D_B)
    console.print(
        f"local damping of a leg, ankle to hip, phi and theta: {D_B} N m s/rad; tau_coupled: two "
        f"poles at {schedule.coupling_bandwidth_hz:g} Hz, damping up to "
        f"{schedule.coupling_damping:g} B_p"
    )
    nodes = split_program.dynamic_nodes(robot, schedule)[::ROOM_EVERY]
    certificate, design = DynamicCertificate(robot, nodes), split_program.design_of(schedule)
    worst = certificate.worst(design, TRACK + HELD)
    console.print(f"least stable of the required conditions: {worst.words()}", soft_wrap=True)
    parked = certificate.worst(design, PARKED)
    console.print(f"least stable while parked: {parked.words()}", soft_wrap=True)
    fades = certificate.sway(design)
    console.print(f"slowest oscillation while led decays at {-fades:.2f}/s")
    blind = certificate.worst(design, BLIND).growth.rate
    console.print(
        f"while an encoder is blind ({1e3 * BLIND_S:.0f} ms), a motion grows to at most "
        f"{math.exp(BLIND_S * blind):.2f} times its size"
    )


def _show_stiffness(robot: RobotConfig) -> int:
    """Print the body's stiffness design along x and y, and compare law.K_p with it."""
    design = for_robot(robot)
    table = Table(title="Body stiffness, legs straight (paper section IV)", title_justify="left")
    table.add_column("")
    for direction in design:
        table.add_column(direction, justify="right", no_wrap=True)
    table.add_column("unit")
    table.add_column("what")
    for key, unit, what in STIFFNESS_ROWS:
        table.add_row(key, *(_stiffness(key, row) for row in design.values()), unit, what)
    console = Console()
    console.print(table)
    edge = math.degrees(design["y"].theta_edge)
    console.print(
        f"theta_edge along y: {edge:.2f} deg. The paper's numbers are those in column y: its "
        "theta_edge uses w_foot / 2, although its formula has l_foot.",
        style="dim",
    )
    for direction, stiffness in zip(design, robot.law.K_p, strict=False):
        least = design[direction].K_min
        word = "above" if stiffness > least else "BELOW"
        console.print(
            f"law.K_p along {direction}: {stiffness:g} N/m, {word} K_min, {least:.0f} N/m"
        )
    return 0


def _stiffness(key: str, row: BodyStiffness) -> str:
    value: float = getattr(row, key)
    if math.isnan(value):
        return "any"
    if key.startswith("theta"):
        return f"{value:.4f}"
    return f"{value:.2f}" if value < 1000 else f"{value:.0f}"
