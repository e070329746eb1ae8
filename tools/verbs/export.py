"""`xrl log export`: a run for others: a 3-D scene in it, a picture, tables, a bag of ROS 2."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from rich.progress import Progress

from shared.clock import NS_PER_S
from shared.exceptions import RunError
from shared.extras import require
from shared.mcap_log.files import SUFFIX
from shared.mcap_log.log_copy import write_extended
from shared.places import FILES
from tools.export.folders import whole_folder
from tools.export.tables import (
    FOR_REEXECUTION,
    GRID_NAME,
    CsvFile,
    ParquetFile,
    write_grid,
    write_tables,
)
from tools.judge.reports import scene
from tools.judge.run_parts import add_part, part_of
from tools.logs.run_index import RunIndex
from tools.logs.run_log import SEE_INFO, RunLog, RunPart, parts_of, read_part, robot_of
from tools.number_arguments import rate
from tools.output import progress_along, write_atomically
from tools.terminal import Console, marked
from tools.topic_keys import keys_named
from tools.verb_table import RUN_HELP, Subparsers, add_verb

SCENE_SUFFIX: Final = ".scene" + SUFFIX
LAYOUT: Final = FILES / "foxglove" / "xrl.json"
"""For a robot of this name; `--layout` writes it for the name in the log."""
LAYOUT_ROBOT: Final = "xrl"
BAG_RATE_HZ: Final = 100.0
"""Of joint states, transforms and wrench in a bag."""


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "export",
        """
        xrl log export out/a/run.mcap --scene
        xrl log export out/a/run.mcap --scene -o shown.mcap --layout layout.json
        xrl log export out/a/run.mcap --gif squat.gif     # the robot moving, from side and front
        xrl log export out/a/run.mcap --gif shove.gif --from 5 --to 9
        xrl log export out/a/run.mcap --gif fig7.gif --curves     # with curves, as the paper's Fig. 7
        xrl log export out/a --csv tables                         # a file for each topic and module
        xrl log export out/a --parquet t --rate 100 --topic 'joint/*/state' --topic harness/wrench
        xrl log export out/a --ros2bag bag                        # ros2 bag play bag
        """,
    )
    parser.add_argument("file", type=Path, metavar="FILE", help=f"{RUN_HELP}; it is not touched")
    parser.add_argument(
        "--scene",
        action="store_true",
        help="copy it with frames, bodies and forces at 30 Hz, for the 3-D views of Foxglove "
        "(all of it) and Rerun (frames and bodies)",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="OUT",
        help="where the copy goes (default: NAME.scene.mcap beside the record)",
    )
    parser.add_argument(
        "--layout",
        type=Path,
        metavar="FILE",
        help="also write Foxglove's layout for this robot's name (that for "
        "`xrl` is shipped, deploy/foxglove/xrl.json)",
    )
    parser.add_argument(
        "--gif",
        type=Path,
        metavar="FILE",
        help="also draw the robot from the side and the front, as an animated picture",
    )
    parser.add_argument(
        "--curves", action="store_true", help="beside it COM, height and hand as they come"
    )
    for flag, what in (("--csv", "CSV"), ("--parquet", "Parquet")):
        parser.add_argument(
            flag,
            type=Path,
            metavar="DIR",
            help=f"also write {what} tables: a file for each key, with all of its messages",
        )
    parser.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="NAME",
        help="only these topics in the tables, such as 'joint/*/state'; may be repeated",
    )
    parser.add_argument(
        "--ros2bag",
        type=Path,
        metavar="DIR",
        help="also write a bag of ROS 2 (MCAP): joint states, transforms, wrench, diagnostics",
    )
    parser.add_argument(
        "--rate",
        type=rate,
        metavar="HZ",
        help="of the tables: all topics in one, at each time the newest messages; of the bag: "
        f"default {BAG_RATE_HZ:g} Hz",
    )
    add_part(parser, "of picture, tables and bag")
    parser.add_argument("--force", action="store_true", help="replace what exists")


def run(args: argparse.Namespace) -> int:
    """Write the requested files."""
    asked = (args.layout, args.gif, args.csv, args.parquet, args.ros2bag)
    if not args.scene and all(out is None for out in asked):
        raise RunError(
            "say what to write: --scene, --layout FILE, --gif FILE, --csv DIR, --parquet DIR, "
            "--ros2bag DIR, or several of them"
        )
    tables: list[tuple[Path | None, type[CsvFile] | type[ParquetFile]]] = [
        (args.csv, CsvFile), (args.parquet, ParquetFile),
    ]  # fmt: skip
    if args.topic and args.csv is None and args.parquet is None:
        raise RunError("--topic chooses what is in tables: add --csv DIR or --parquet DIR")
    if args.rate is not None and all(out is None for out in asked[2:]):
        raise RunError("--rate is that of tables or of a bag: add --csv, --parquet or --ros2bag")
    for extra, wanted, otherwise in (
        ("foxglove", args.scene, ""),
        ("plot", args.gif, ""),
        ("parquet", args.parquet, "take --csv"),
        ("ros2", args.ros2bag, ""),
    ):
        if wanted:
            require(extra, otherwise)
    if args.curves and args.gif is None:
        raise RunError("--curves go beside a picture: name it with --gif FILE")
    path: Path = args.file
    if path.is_dir() and args.scene:
        raise RunError(f"{path}: is a directory; give --scene one of its files")
    index = RunIndex(path)
    part = part_of(args, index)
    console = Console()
    if args.scene:
        out: Path = args.out or path.with_name(path.name.removesuffix(SUFFIX) + SCENE_SUFFIX)
        _free(out, path, force=args.force)
        count = export_scene(index, out)
        console.print(marked("[bold]{}[/]: {} messages", out, count), soft_wrap=True)
    if args.gif is not None:
        _free(args.gif, path, force=args.force)
        _draw(read_part(index, part), args.gif, console, with_curves=args.curves)
    for folder, kind in tables:
        if folder is not None:
            _write_tables(index, part, args, folder, kind, console)
    if args.ros2bag is not None:
        _write_bag(index, part, args, console)
    if args.layout is not None:
        _free(args.layout, path, force=args.force)
        write_atomically(
            args.layout, json.dumps(layout_for(index.robot), indent=2).encode() + b"\n"
        )
        console.print(marked("[bold]{}[/]: import it in Foxglove", args.layout))
    return 0


def _write_tables(
    index: RunIndex,
    part: RunPart,
    args: argparse.Namespace,
    out: Path,
    kind: type[CsvFile] | type[ParquetFile],
    console: Console,
) -> None:
    """Write a folder of tables, with progress."""
    keys = keys_named(args.topic, FOR_REEXECUTION)
    with (
        whole_folder(out, index.path, force=args.force) as folder,
        progress_along("writing", index.length_s) as done,
    ):
        folder.mkdir()
        if args.rate is None:
            rows = write_tables(index, part, keys, folder, kind, done)
        else:
            grid = write_grid(index, part, keys, args.rate, folder / GRID_NAME, kind, done)
            rows = {GRID_NAME: grid}
        if not any(rows.values()):
            raise RunError(f"{index.path}: has no message of these topics in this part; {SEE_INFO}")
    told = f"{len(rows)} table{'s' * (len(rows) != 1)}, {sum(rows.values())} rows"
    console.print(marked("[bold]{}[/]: {}", out, told), soft_wrap=True)


def _write_bag(index: RunIndex, part: RunPart, args: argparse.Namespace, console: Console) -> None:
    """Write a bag of ROS 2, with progress."""
    require("ros2")
    from tools.export.ros2_bag import write_bag  # noqa: PLC0415 - needs the extra

    with (
        whole_folder(args.ros2bag, index.path, force=args.force) as folder,
        progress_along("writing", index.length_s) as done,
    ):
        rate_hz = args.rate or BAG_RATE_HZ
        count = write_bag(index, part, robot_of(index), folder, rate_hz, done)
    told = f"{count} messages; ros2 bag play {args.ros2bag}"
    console.print(marked("[bold]{}[/]: {}", args.ros2bag, told), soft_wrap=True)


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


def export_scene(index: RunIndex, out: Path) -> int:
    """Write a copy of a log with its scene, with progress; return how many messages it has.

    Raises:
        RunError: the log cannot be copied or lacks states, or the copy cannot be written.
    """
    robot = robot_of(index)

    def parts() -> Iterator[RunLog]:
        with progress_along("copying", index.length_s) as done:
            for log in parts_of(index):
                yield log
                done((log.end_ns - log.began_ns()) / NS_PER_S)

    return write_extended(
        index.path, out, scene.channels(index.robot), scene.messages(parts(), robot)
    )


def layout_for(robot: str) -> dict[str, Any]:
    """Return Foxglove's layout for a robot of some name.

    Raises:
        RunError: it is not where this project has it.
    """
    try:
        text = LAYOUT.read_text(encoding="utf-8")
    except OSError as error:
        raise RunError(f"{LAYOUT}: cannot be read: {error.strerror}") from None
    found: dict[str, Any] = json.loads(text.replace(f"xrl/{LAYOUT_ROBOT}/", f"xrl/{robot}/"))
    return found


def _free(out: Path, source: Path, *, force: bool) -> None:
    if out.exists() and source.exists() and out.samefile(source):
        raise RunError(f"{out}: is the record itself, which stays as it is; give another name")
    if out.exists() and not force:
        raise RunError(f"{out}: exists already; remove it, give another name, or --force")
