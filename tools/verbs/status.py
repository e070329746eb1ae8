"""`xrl status`: every service and every module."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec
from rich.console import Group

from shared.bus.session import open_session
from shared.clock import pace
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.process import StopFlag
from tools.flags import Arg, RunDirFlags
from tools.fleet.fleet_status import BusFaults, listen_for_all, monitors_of, read_status
from tools.fleet.process_table import services_elsewhere
from tools.fleet.procfs import use_of
from tools.fleet.status_table import process_table, tables
from tools.fleet.supervise import SupervisedFleet
from tools.fleet.traffic import LINKS_S, Traffic, traffic_table
from tools.terminal import Console, renewed
from tools.topic_keys import keys_named

WINDOW_S: Final = 1.0

EXAMPLES: Final = """
xrl status
xrl status --watch
xrl status --watch --traffic     # one screen: CPU of processes, rates of topics
xrl status --json | jq .services.planner
"""


class StatusFlags(RunDirFlags):
    """What is shown, and how often."""

    json: Annotated[bool, Arg(exclusive="form")] = False
    """print JSON, in SI units"""
    watch: Annotated[bool, Arg(exclusive="form")] = False
    """refresh until Ctrl-C"""
    traffic: bool = False
    """show processes and topics instead of services and modules: CPU, rates, ages, bytes"""

    def check(self) -> None:
        """Refuse JSON of what has none."""
        super().check()
        if self.json and self.traffic:
            raise RunError("--traffic is a screen for people; --json shows services and modules")


def run(flags: StatusFlags) -> int:
    """Look at the fleet once, or until interrupted."""
    fleet = SupervisedFleet.attach(flags.run_dir, warn=False)  # it is in the table
    robot = fleet.manifest.robot()
    if flags.traffic:
        return _show_traffic(fleet, robot, watch=flags.watch)
    with open_session(robot, "status", fleet.run.path) as session:
        monitors = monitors_of(session, fleet.manifest.topics)
        listen_for_all(monitors)
        bus = BusFaults(robot, session)
        if flags.json:
            status = read_status(fleet, monitors, bus)
            print(msgspec.json.format(msgspec.json.encode(status)).decode())
            return 0
        if not flags.watch:
            Console().print(tables(read_status(fleet, monitors, bus)))
            return 0
        with renewed(Console()) as show:
            while True:
                show(tables(read_status(fleet, monitors, bus)))


def _show_traffic(fleet: SupervisedFleet, robot: RobotConfig, *, watch: bool) -> int:
    console, stop = Console(), StopFlag()
    with open_session(robot, "status", fleet.run.path) as session:
        elsewhere = services_elsewhere(robot, fleet.run.path)
        traffic = Traffic(session, keys_named(()), elsewhere)
        traffic.listen(LINKS_S)
        if not watch:
            console.print(_screen(fleet, traffic, stop))
            return 0
        with renewed(console, screen=True) as show:
            while not stop:
                show(_screen(fleet, traffic, stop))
    return 0


def _screen(fleet: SupervisedFleet, traffic: Traffic, stop: StopFlag) -> Group:
    """Watch for a window, and return what was seen; rates are those of the fleet's clock."""
    services = fleet.info()
    pids = [row.pid for row in services if row.pid]
    before = use_of(pids)
    window_s = traffic.listen(WINDOW_S, lambda: bool(stop))
    processes = process_table(services, before, use_of(pids), window_s)
    return Group(processes, traffic_table(traffic, window_s * pace(), only_seen=True))
