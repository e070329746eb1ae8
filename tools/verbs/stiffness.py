"""`xrl gains --stiffness`: how stiff the body must be to balance (paper section IV)."""

from __future__ import annotations

import argparse
import math

from rich.table import Table

from shared.config import files as config_file
from tools.lab.design.body_stiffness import BodyStiffness, for_robot
from tools.terminal import Console
from tools.verb_table import Subparsers, add_config, add_verb

ROWS = (
    ("theta_max", "rad", "largest lean the ankles' torque can hold"),
    ("theta_edge", "rad", "lean with the COM over the sole's edge"),
    ("tau_edge", "N m", "each ankle's torque there"),
    ("K_ank_min", "N m/rad", "least stiffness of each ankle"),
    ("K_min", "N/m", "least stiffness of the body"),
    ("K_tau_max", "N/m", "stiffness that gives tau_max at the edge"),
)


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "stiffness",
        """
        xrl gains --stiffness
        xrl gains --stiffness --config lab.toml
        """,
    )
    add_config(parser)


def run(args: argparse.Namespace) -> int:
    """Print the design for x and y."""
    robot = config_file.load(args.config)
    design = for_robot(robot)
    table = Table(title="Body stiffness, legs straight (paper section IV)", title_justify="left")
    table.add_column("")
    for direction in design:
        table.add_column(direction, justify="right", no_wrap=True)
    table.add_column("unit")
    table.add_column("what")
    for key, unit, what in ROWS:
        table.add_row(key, *(_value(key, row) for row in design.values()), unit, what)
    console = Console()
    console.print(table)
    edge = math.degrees(design["y"].theta_edge)
    console.print(
        f"theta_edge along y: {edge:.2f} deg. The paper's numbers are the column y: its "
        "theta_edge is that of w_foot / 2, though its formula prints l_foot.",
        style="dim",
    )
    for direction, stiffness in zip(design, robot.law.K_p, strict=False):
        least = design[direction].K_min
        word = "above" if stiffness > least else "BELOW"
        console.print(f"law.K_p along {direction}: {stiffness:g} N/m, {word} {least:.0f} N/m")
    return 0


def _value(key: str, row: BodyStiffness) -> str:
    value: float = getattr(row, key)
    if math.isnan(value):
        return "any"
    if key.startswith("theta"):
        return f"{value:.4f}"
    return f"{value:.2f}" if value < 1000 else f"{value:.0f}"
