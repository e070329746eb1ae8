"""`xrl log report`: writes a report of a run as one page that any browser shows offline."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import Annotated, Final, Literal

from shared.exceptions import RunError
from tools.flags import Run, option
from tools.judge.reports.page import render_parts
from tools.judge.run_parts import PartFlags, part_of
from tools.logs.run_index import RunIndex
from tools.output import progress_along, refuse_taken, write_atomically
from tools.terminal import Console, marked

MIB: Final = 1 << 20


EXAMPLES: Final = """
xrl log report out/a/run.mcap
xrl log report out/a/run.mcap -o report.html --open no
"""


class ReportFlags(PartFlags):
    """Run to report on, and path of the page."""

    file: Run
    out: Annotated[Path | None, option("-o", "--out", metavar="OUT")] = None
    """path of the page (default: NAME.html beside the log)"""
    open: Literal["yes", "no", "auto"] = "auto"
    """open the page in a browser; auto: only in a terminal with a display"""


def run(flags: ReportFlags) -> int:
    """Write the page."""
    path = flags.file
    index = RunIndex(path)
    part = part_of(flags, index)
    out = flags.out or index.files[0].with_suffix(".html")
    if out.is_dir():
        raise RunError(f"{out}: is a directory; give a file with -o")
    refuse_taken(out, path, force=True)
    with progress_along("reading", min(part.end_s, index.length_s)) as done:
        page = render_parts(index, part, done=done).encode()
    write_atomically(out, page)
    Console().print(
        marked("[bold]{}[/]: {:.2f} MiB, one file", out, len(page) / MIB), soft_wrap=True
    )
    if flags.open == "yes" or (flags.open == "auto" and _has_display()):
        webbrowser.open(out.resolve().as_uri())
    return 0


def _has_display() -> bool:
    display = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return sys.stdout.isatty() and display
