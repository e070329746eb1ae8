"""`xrl log report`: writes a run as one page that opens in any browser without a network."""

from __future__ import annotations

import argparse
import os
import sys
import webbrowser
from pathlib import Path
from typing import Final

from shared.exceptions import RunError
from tools.judge.reports.page import render_parts
from tools.judge.run_parts import add_part, part_of
from tools.logs.run_index import RunIndex
from tools.output import progress_along, write_atomically
from tools.terminal import Console, marked
from tools.verb_table import RUN_HELP, Subparsers, add_verb

MIB: Final = 1 << 20


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "report",
        """
        xrl log report out/a/run.mcap
        xrl log report out/a/run.mcap -o report.html --open no
        xrl log report out/a/run.mcap --from 1200 --to 1260   # a minute of an hour
        """,
    )
    parser.add_argument("file", type=Path, metavar="RUN", help=RUN_HELP)
    add_part(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="OUT",
        help="path of the page (default: NAME.html beside the log); an old page is replaced",
    )
    parser.add_argument(
        "--open",
        choices=("yes", "no", "auto"),
        default="auto",
        help="open the page in a browser; auto (default): if run in a terminal with a display",
    )


def run(args: argparse.Namespace) -> int:
    """Write the page."""
    path: Path = args.file
    index = RunIndex(path)
    part = part_of(args, index)
    out: Path = args.out or index.files[0].with_suffix(".html")
    if out.is_dir():
        raise RunError(f"{out}: is a directory; give a file with -o")
    if out.exists() and path.exists() and out.samefile(path):
        raise RunError(f"{out}: is the log itself; give another file with -o")
    with progress_along("reading", min(part.end_s, index.length_s)) as done:
        page = render_parts(index, part, done=done).encode()
    write_atomically(out, page)
    Console().print(
        marked("[bold]{}[/]: {:.2f} MiB, one file", out, len(page) / MIB), soft_wrap=True
    )
    if args.open == "yes" or (args.open == "auto" and _has_display()):
        webbrowser.open(out.resolve().as_uri())
    return 0


def _has_display() -> bool:
    display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return sys.stdout.isatty() and display
