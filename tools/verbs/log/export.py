"""`xrl log export`: writes a run as an animation, CSV tables or a ROS 2 bag."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from rich.progress import Progress

from shared.exceptions import RunError
from shared.extras import require
from tools.export.tables import FOR_REEXECUTION, GRID_NAME, write_grid, write_tables
from tools.flags import RUN_HELP, Arg, Folder, Rate, positional
from tools.judge.run_parts import PartFlags, part_of
from tools.logs.run_index import RunIndex
from tools.logs.run_log import SEE_INFO, RunLog, RunPart, read_part, robot_of
from tools.output import progress_along, refuse_taken, whole_folder
from tools.terminal import Console, marked
from tools.topic_keys import keys_named

BAG_RATE_HZ: Final = 100.0
"""Default rate of joint states, transforms and wrench in a bag."""


EXAMPLES: Final = """
xrl log export out/a/run.mcap --gif squat.gif
xrl log export out/a --csv tables
xrl log export out/a --csv t --rate 100 --topic 'joint/*/state' --topic harness/wrench
xrl log export out/a --ros2bag bag                        # ros2 bag play bag
"""


class ExportFlags(PartFlags):
    """Run to export, and the formats to write."""

    file: Annotated[Path, positional("RUN", help=RUN_HELP)]
    gif: Path | None = None
    """write an animated GIF of the robot from side and front"""
    csv: Folder | None = None
    """write CSV tables, one per topic and module"""
    topic: Annotated[tuple[str, ...], Arg(metavar="NAME")] = ()
    """only this topic in the tables, such as 'joint/*/state'; repeatable (default: all but
    joint/*/trace, planner/checkpoint and sim/state)"""
    ros2bag: Folder | None = None
    """write a ROS 2 bag (MCAP): joint states, transforms, wrench, diagnostics"""
    rate: Annotated[
        Rate | None,
        Arg(
            help="with --csv: write one table, with the newest message of each topic at this rate; "
            f"with --ros2bag: rate of joint states, transforms, wrench (default: {BAG_RATE_HZ:g})"
        ),
    ] = None
    force: bool = False
    """replace existing files"""

    def check(self) -> None:
        """Refuse a command without an output, and flags of outputs that are not written."""
        super().check()
        if not (self.gif or self.csv or self.ros2bag):
            raise RunError(
                "no output is given; add --gif FILE, --csv DIR, --ros2bag DIR, or several of them"
            )
        if self.topic and self.csv is None:
            raise RunError("--topic selects the topics of tables; add --csv DIR")
        if self.rate is not None and self.csv is None and self.ros2bag is None:
            raise RunError("--rate is for tables or a bag; add --csv DIR or --ros2bag DIR")


def run(flags: ExportFlags) -> int:
    """Write the requested files."""
    for extra, wanted in (("plot", flags.gif), ("ros2", flags.ros2bag)):
        if wanted:
            require(extra)
    path = flags.file
    index = RunIndex(path)
    part = part_of(flags, index)
    console = Console()
    if flags.gif is not None:
        refuse_taken(flags.gif, path, force=flags.force)
        _draw(read_part(index, part), flags.gif, console)
    if flags.csv is not None:
        _write_tables(index, part, flags, flags.csv, console)
    if flags.ros2bag is not None:
        _write_bag(index, part, flags, flags.ros2bag, console)
    return 0


def _write_tables(
    index: RunIndex, part: RunPart, flags: ExportFlags, out: Path, console: Console
) -> None:
    """Write a folder of tables, with progress."""
    keys = keys_named(flags.topic, FOR_REEXECUTION)
    with (
        whole_folder(out, index.path, force=flags.force) as folder,
        progress_along("writing", index.length_s) as done,
    ):
        folder.mkdir()
        if flags.rate is None:
            rows = write_tables(index, part, keys, folder, done)
        else:
            grid = write_grid(index, part, keys, flags.rate, folder / GRID_NAME, done)
            rows = {GRID_NAME: grid}
        if not any(rows.values()):
            raise RunError(f"{index.path}: has no message of these topics in this part; {SEE_INFO}")
    told = f"{len(rows)} table{'s' * (len(rows) != 1)}, {sum(rows.values())} rows"
    console.print(marked("[bold]{}[/]: {}", out, told), soft_wrap=True)


def _write_bag(
    index: RunIndex, part: RunPart, flags: ExportFlags, out: Path, console: Console
) -> None:
    """Write a ROS 2 bag, with progress."""
    require("ros2")
    from tools.export.ros2_bag import write_bag  # noqa: PLC0415 - needs the extra

    with (
        whole_folder(out, index.path, force=flags.force) as folder,
        progress_along("writing", index.length_s) as done,
    ):
        rate_hz = flags.rate or BAG_RATE_HZ
        count = write_bag(index, part, robot_of(index), folder, rate_hz, done)
    told = f"{count} messages; ros2 bag play {out}"
    console.print(marked("[bold]{}[/]: {}", out, told), soft_wrap=True)


def _draw(log: RunLog, out: Path, console: Console) -> None:
    """Write the run's animation, with progress."""
    require("plot")
    from tools.judge.reports.moving_picture import write_gif  # noqa: PLC0415 - needs the extra

    with Progress(console=console, transient=True) as shown:
        bar = shown.add_task("drawing", total=1.0)
        count = write_gif(log, robot_of(log), out, lambda part: shown.update(bar, completed=part))
    console.print(marked("[bold]{}[/]: {} frames", out, count), soft_wrap=True)
