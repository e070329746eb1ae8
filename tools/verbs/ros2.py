"""`xrl ros2`: what ROS 2 sees of the robot."""

from __future__ import annotations

import argparse
import os

import msgspec

from services.ros2_gateway.rmw import domain
from shared.config import checks
from shared.config.files import load
from shared.exceptions import FAULT_EXIT_CODE
from shared.extras import require
from tools.fleet.ros2_check import check
from tools.number_arguments import finite
from tools.terminal import Console, marked
from tools.verb_table import Subparsers, add_config, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "ros2",
        """
        xrl up --ros2 && xrl ros2 check
        xrl ros2 check --domain 7 --router tcp/192.168.0.2:7447
        """,
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    looks = actions.add_parser(
        "check", help="join the network as a node: is the robot there, with all of its topics?"
    )
    add_config(looks)
    looks.add_argument(
        "--domain",
        type=domain,
        default=os.environ.get("ROS_DOMAIN_ID") or "0",
        metavar="N",
        help="domain (default: $ROS_DOMAIN_ID, else 0)",
    )
    looks.add_argument(
        "--router", metavar="ENDPOINT", help="router (default: ros2.router of the robot file)"
    )
    looks.add_argument(
        "--wait",
        type=finite,
        default=5.0,
        metavar="S",
        help="time in which router and node must be there (default: 5 s)",
    )


def run(args: argparse.Namespace) -> int:
    """Look, and print what was found; 0 if nothing is missing."""
    require("ros2")
    robot = load(args.config)
    if args.router is not None:
        ros2 = msgspec.structs.replace(robot.ros2, router=args.router)
        robot = msgspec.structs.replace(robot, ros2=ros2)
        checks.check("--router", robot)
    rows = check(robot, args.domain, args.wait)
    console = Console(highlight=False)
    for row in rows:
        mark = marked("[green]ok[/]") if row.good else marked("[bold red]no[/]")
        console.print(marked("{}  {}: {}", mark, row.what, row.found), soft_wrap=True)
        if not row.good:
            console.print(f"      {row.fix}", soft_wrap=True)
    return 0 if all(row.good for row in rows) else FAULT_EXIT_CODE
