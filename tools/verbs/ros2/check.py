"""`xrl ros2 check`: what ROS 2 sees of the robot."""

from __future__ import annotations

import argparse
import dataclasses
import os
from typing import Annotated, Final

import msgspec

from services.ros2_gateway import rmw
from shared.config import checks
from shared.config.files import load
from shared.exceptions import FAULT_EXIT_CODE, RunError
from shared.extras import require
from tools.flags import Arg, ConfigFlags, Seconds, parsed
from tools.fleet.ros2_check import check
from tools.terminal import Console, marked

EXAMPLES: Final = """
xrl up --ros2 && xrl ros2 check
xrl ros2 check --domain 7 --router tcp/192.168.0.2:7447
"""


def _domain_here() -> int:
    try:
        return rmw.domain(os.environ.get("ROS_DOMAIN_ID") or "0")
    except argparse.ArgumentTypeError as error:
        raise RunError(f"ROS_DOMAIN_ID: {error}") from None


class CheckFlags(ConfigFlags):
    """Which network."""

    domain: Annotated[int, parsed(rmw.domain, "N")] = dataclasses.field(
        default_factory=_domain_here
    )
    """domain (default: $ROS_DOMAIN_ID, else 0)"""
    router: Annotated[str | None, Arg(metavar="ENDPOINT")] = None
    """router (default: ros2.router of the robot file)"""
    wait: Seconds = 5.0
    """longest wait for router and node"""


def run(flags: CheckFlags) -> int:
    """Look, and print what was found; 0 if nothing is missing."""
    require("ros2")
    robot = load(flags.config)
    if flags.router is not None:
        ros2 = msgspec.structs.replace(robot.ros2, router=flags.router)
        robot = msgspec.structs.replace(robot, ros2=ros2)
        checks.check("--router", robot)
    rows = check(robot, flags.domain, flags.wait)
    console = Console(highlight=False)
    for row in rows:
        mark = marked("[green]ok[/]") if row.good else marked("[bold red]no[/]")
        console.print(marked("{}  {}: {}", mark, row.what, row.found), soft_wrap=True)
        if not row.good:
            console.print(f"      {row.fix}", soft_wrap=True)
    return 0 if all(row.good for row in rows) else FAULT_EXIT_CODE
