"""`xrl doctor`: is this robot as it should be? Looks, and moves and changes nothing."""

from __future__ import annotations

from typing import Final

import msgspec
from rich.text import Text

from shared.config import files as config_file
from shared.exceptions import FAULT_EXIT_CODE
from tools.bringup.drive_access import DriveSettingFlags, check_plants, robot_file
from tools.bringup.findings import report_of, show
from tools.bringup.survey import survey
from tools.flags import FleetRobotFlags
from tools.terminal import Console

EXAMPLES: Final = """
xrl doctor
xrl doctor --config lab.toml --verbose
xrl doctor --json | jq '.groups[][] | select(.verdict == "wrong")'
xrl doctor --plant knee_left.axis0.controller.config.vel_limit=2
"""


class DoctorFlags(FleetRobotFlags, DriveSettingFlags):
    """What is shown."""

    verbose: bool = False
    """also show each check that is ok"""
    json: bool = False
    """print JSON: every row"""


def run(flags: DoctorFlags) -> int:
    """Look at everything; 0 if nothing is wrong."""
    path = robot_file(flags)
    robot = config_file.load(path)
    check_plants(robot, flags.run_dir, flags.plant)
    with Console(stderr=True).status("looking") as status:
        groups = survey(
            robot,
            path,
            flags.run_dir,
            flags.plant,
            lambda words: status.update(Text(f"looking at {words}")),
        )
    report = report_of(groups)
    if flags.json:
        print(msgspec.json.format(msgspec.json.encode(report)).decode())
    else:
        show(Console(), groups, verbose=flags.verbose)
    return 0 if report.ok else FAULT_EXIT_CODE
