"""`xrl status`: shows every service and module; exit code 1 if the robot has fallen."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from shared.bus.session import open_session
from tools.flags import Arg, RunDirFlags
from tools.fleet.fleet_status import BusFaults, listen_for_all, monitors_of, read_status
from tools.fleet.status_table import tables
from tools.fleet.supervise import SupervisedFleet
from tools.terminal import Console, renewed

EXAMPLES: Final = """
xrl status
xrl status --json | jq .services.planner
"""


class StatusFlags(RunDirFlags):
    """Output format, and whether to refresh it."""

    json: Annotated[bool, Arg(exclusive="form")] = False
    """print JSON"""
    watch: Annotated[bool, Arg(exclusive="form")] = False
    """refresh until Ctrl-C"""


def run(flags: StatusFlags) -> int:
    """Show the fleet once, or until interrupted."""
    fleet = SupervisedFleet.attach(flags.run_dir, warn=False)  # the table shows the warning
    robot = fleet.manifest.robot()
    with open_session(robot, "status", fleet.run.path) as session:
        monitors = monitors_of(session, fleet.manifest.topics)
        listen_for_all(monitors)
        bus = BusFaults(robot, session)
        if flags.json:
            status = read_status(fleet, monitors, bus)
            print(msgspec.json.format(msgspec.json.encode(status)).decode())
            return status.exit_code
        if not flags.watch:
            status = read_status(fleet, monitors, bus)
            Console().print(tables(status))
            return status.exit_code
        with renewed(Console()) as show:
            while True:
                show(tables(read_status(fleet, monitors, bus)))
