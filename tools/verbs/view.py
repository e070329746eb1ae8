"""`xrl view`: shows the robot in a browser."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final

from shared import places
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError, RunError
from shared.extras import require
from tools.flags import Arg, Run, RunDirFlags
from tools.fleet.supervise import SupervisedFleet
from tools.judge.run_parts import PartFlags, read_asked
from tools.live.experiment import load_robot
from tools.logs.run_index import RunIndex
from tools.logs.run_log import robot_of
from tools.output import progress_along, refuse_taken, write_atomically
from tools.terminal import Console, marked
from tools.view.frame import Source
from tools.view.live import LiveSource
from tools.view.lockstep import LockstepSource
from tools.view.record import RecordFrames, single_file
from tools.view.serving import PortFlags, serve

EXAMPLES: Final = """
xrl view                       # show the running fleet
xrl view --act                 # ... and lead, push, kill, freeze, start, cut, stop
xrl view out/demo/run.mcap     # write a record as one page
xrl view --sim
"""


class ViewFlags(PortFlags, PartFlags, RunDirFlags):
    """Source to show, and how to serve it."""

    record: Run | None = None
    sim: bool = False
    """simulate a robot in this process, in virtual time"""
    html: Path | None = None
    """path of a record's page, which needs no server (default: NAME.view.html beside the record)"""
    act: bool = False
    """let the page act on the running fleet; for a real robot you must type its name first"""
    config: Annotated[Path | None, Arg(metavar="FILE", help=f"with --sim: {places.HELP}")] = None

    def check(self) -> None:
        """Refuse flags that contradict a record or --sim."""
        super().check()
        if self.sim and self.record is not None:
            raise RunError("a record and --sim cannot be combined; remove one of them")
        if self.act and (self.sim or self.record is not None):
            raise RunError(
                "--act needs a running fleet; remove --act: with --sim a page can always act, and "
                "with a record never"
            )
        if self.html is not None and self.record is None:
            raise RunError("--html needs a record; give one, such as out/demo/run.mcap")


def run(flags: ViewFlags) -> int:
    """Serve until Ctrl-C, or write a record's page."""
    if flags.sim:
        require("sim")
    if flags.record is not None:
        return _write(flags, RunIndex(flags.record))
    require("view")
    with _source(flags) as source:
        serve(source, flags.port)
    return 0


@contextlib.contextmanager
def _source(flags: ViewFlags) -> Iterator[Source]:
    if flags.sim:
        lockstep = LockstepSource(load_robot(places.robot_file(flags.config)))
        try:
            yield lockstep
        finally:
            lockstep.close()
    else:
        fleet = SupervisedFleet.attach(flags.run_dir)
        robot = fleet.manifest.robot()
        if flags.act and "simulator" not in fleet.manifest.services:
            confirm(robot)
        live = LiveSource(robot, fleet, act=flags.act)
        try:
            yield live
        finally:
            live.disconnect()


def _write(flags: ViewFlags, index: RunIndex) -> int:
    """Write a record as one page."""
    log = read_asked(flags, index)
    record = RecordFrames(log, robot_of(log))
    length_s = record.model.end_s - record.model.begin_s
    with progress_along("frames", length_s) as done:
        content = single_file(record, done)
    out = flags.html or index.files[0].with_suffix(".view.html")
    refuse_taken(out, index.files[0], force=True)
    write_atomically(out, content)
    print(f"{out}: {length_s:.1f} s, {len(content) / 1e6:.1f} MB; open it in a browser")
    return 0


def confirm(robot: RobotConfig) -> None:
    """Require a person to type the name of a real robot before a page may act on it."""
    if not sys.stdin.isatty():
        raise FleetError(
            "a page may act on a real robot only after a person types its name; run `xrl view "
            "--act` in a terminal"
        )
    console = Console()
    console.print(
        marked(
            "[bold red]This is a real robot.[/] A page can kill its services and stop it, but does "
            "not replace a switch that cuts the power."
        )
    )
    typed = console.input(f"Type its name ({robot.name}) to continue: ")
    if typed.strip() != robot.name:
        raise FleetError(f"{typed.strip()!r} is not the name of this robot; nothing was started")
