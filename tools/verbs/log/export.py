"""`xrl log export`: a run for others: a picture, tables, a bag of ROS 2."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Final

from rich.progress import Progress

from shared.exceptions import RunError
from shared.extras import require
from shared.places import FILES
from tools.export.folders import whole_folder
from tools.export.tables import (
    FOR_REEXECUTION,
    GRID_NAME,
    CsvFile,
    ParquetFile,
    TableKind,
    write_grid,
    write_tables,
)
from tools.flags import RUN_HELP, Arg, Folder, Rate, positional
from tools.judge.run_parts import PartFlags, part_of
from tools.logs.run_index import RunIndex
from tools.logs.run_log import SEE_INFO, RunLog, RunPart, read_part, robot_of
from tools.output import progress_along, refuse_taken, write_atomically
from tools.terminal import Console, marked
from tools.topic_keys import keys_named

LAYOUT: Final = FILES / "foxglove" / "xrl.json"
"""For a robot of this name; `--layout` writes it for the name in the log."""
LAYOUT_ROBOT: Final = "xrl"
BAG_RATE_HZ: Final = 100.0
"""Rate of joint states, transforms and wrench in a bag."""


EXAMPLES: Final = """
xrl log export out/a/run.mcap --layout layout.json
xrl log export out/a/run.mcap --gif squat.gif     # the robot moving, from side and front
xrl log export out/a/run.mcap --gif shove.gif --from 5 --to 9
xrl log export out/a/run.mcap --gif fig7.gif --curves     # with curves, as the paper's Fig. 7
xrl log export out/a --csv tables                         # a file for each topic and module
xrl log export out/a --parquet t --rate 100 --topic 'joint/*/state' --topic harness/wrench
xrl log export out/a --ros2bag bag                        # ros2 bag play bag
"""


class ExportFlags(PartFlags):
    """Which run, and what is made of it."""

    file: Annotated[Path, positional("FILE", help=f"{RUN_HELP}; it is not touched")]
    layout: Path | None = None
    """also write Foxglove's layout for this robot's name (that for `xrl` is shipped,
    deploy/foxglove/xrl.json)"""
    gif: Path | None = None
    """also draw the robot from the side and the front, as an animated picture"""
    curves: bool = False
    """with --gif: add curves of COM, height and hand"""
    csv: Folder | None = None
    """also write CSV tables: a file for each key, with all of its messages"""
    parquet: Folder | None = None
    """also write Parquet tables: a file for each key, with all of its messages"""
    topic: Annotated[tuple[str, ...], Arg(metavar="NAME")] = ()
    """only these topics in the tables, such as 'joint/*/state'; may be repeated"""
    ros2bag: Folder | None = None
    """also write a bag of ROS 2 (MCAP): joint states, transforms, wrench, diagnostics"""
    rate: Annotated[
        Rate | None,
        Arg(
            help="rate of one table of all topics, with the newest messages at each time; "
            f"or of the bag: default {BAG_RATE_HZ:g} Hz"
        ),
    ] = None
    force: bool = False
    """replace what exists"""

    def check(self) -> None:
        """Refuse nothing to write, and what goes with something that is not written."""
        super().check()
        tables = self.csv is not None or self.parquet is not None
        if not (self.layout or self.gif or tables or self.ros2bag):
            raise RunError(
                "say what to write: --layout FILE, --gif FILE, --csv DIR, --parquet DIR, "
                "--ros2bag DIR, or several of them"
            )
        if self.topic and not tables:
            raise RunError("--topic chooses what is in tables: add --csv DIR or --parquet DIR")
        if self.rate is not None and not tables and self.ros2bag is None:
            raise RunError("--rate is that of tables or a bag: add --csv, --parquet or --ros2bag")
        if self.curves and self.gif is None:
            raise RunError("--curves go beside a picture: name it with --gif FILE")


def run(flags: ExportFlags) -> int:
    """Write the requested files."""
    tables: list[tuple[Path | None, TableKind]] = [
        (flags.csv, CsvFile), (flags.parquet, ParquetFile),
    ]  # fmt: skip
    for extra, wanted, otherwise in (
        ("plot", flags.gif, ""),
        ("parquet", flags.parquet, "take --csv"),
        ("ros2", flags.ros2bag, ""),
    ):
        if wanted:
            require(extra, otherwise)
    path = flags.file
    index = RunIndex(path)
    part = part_of(flags, index)
    console = Console()
    if flags.gif is not None:
        refuse_taken(flags.gif, path, force=flags.force)
        _draw(read_part(index, part), flags.gif, console, with_curves=flags.curves)
    for folder, kind in tables:
        if folder is not None:
            _write_tables(index, part, flags, folder, kind, console)
    if flags.ros2bag is not None:
        _write_bag(index, part, flags, flags.ros2bag, console)
    if flags.layout is not None:
        refuse_taken(flags.layout, path, force=flags.force)
        write_atomically(
            flags.layout, json.dumps(layout_for(index.robot), indent=2).encode() + b"\n"
        )
        console.print(marked("[bold]{}[/]: import it in Foxglove", flags.layout))
    return 0


def _write_tables(
    index: RunIndex,
    part: RunPart,
    flags: ExportFlags,
    out: Path,
    kind: TableKind,
    console: Console,
) -> None:
    """Write a folder of tables, with progress."""
    keys = keys_named(flags.topic, FOR_REEXECUTION)
    with (
        whole_folder(out, index.path, force=flags.force) as folder,
        progress_along("writing", index.length_s) as done,
    ):
        folder.mkdir()
        if flags.rate is None:
            rows = write_tables(index, part, keys, folder, kind, done)
        else:
            grid = write_grid(index, part, keys, flags.rate, folder / GRID_NAME, kind, done)
            rows = {GRID_NAME: grid}
        if not any(rows.values()):
            raise RunError(f"{index.path}: has no message of these topics in this part; {SEE_INFO}")
    told = f"{len(rows)} table{'s' * (len(rows) != 1)}, {sum(rows.values())} rows"
    console.print(marked("[bold]{}[/]: {}", out, told), soft_wrap=True)


def _write_bag(
    index: RunIndex, part: RunPart, flags: ExportFlags, out: Path, console: Console
) -> None:
    """Write a bag of ROS 2, with progress."""
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


def _draw(log: RunLog, out: Path, console: Console, *, with_curves: bool) -> None:
    """Draw the run's moving picture, with progress."""
    require("plot")
    from tools.judge.reports.moving_picture import write_gif  # noqa: PLC0415 - needs the extra

    with Progress(console=console, transient=True) as shown:
        bar = shown.add_task("drawing", total=1.0)
        count = write_gif(
            log, robot_of(log), out, lambda part: shown.update(bar, completed=part),
            with_curves=with_curves,
        )  # fmt: skip
    console.print(marked("[bold]{}[/]: {} frames", out, count), soft_wrap=True)


def layout_for(robot: str) -> dict[str, Any]:
    """Return Foxglove's layout for a robot of some name."""
    try:
        text = LAYOUT.read_text(encoding="utf-8")
    except OSError as error:
        raise RunError(f"{LAYOUT}: cannot be read: {error.strerror}") from None
    found: dict[str, Any] = json.loads(text.replace(f"xrl/{LAYOUT_ROBOT}/", f"xrl/{robot}/"))
    return found
