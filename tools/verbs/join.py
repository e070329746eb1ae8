"""`xrl log join`: the fleet's record and those of single hosts become one run."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.progress import Progress

from shared.mcap_log.files import FIRST
from tools.guarded_streams import printable
from tools.live.experiment import make_out
from tools.logs.joined_records import host_record, join
from tools.logs.run_index import RunIndex
from tools.terminal import Console
from tools.verb_table import RUN_HELP, Subparsers, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "join",
        """
        xrl log join out/body out/left out/right --out out/joined
        xrl log resim out/joined
        """,
    )
    parser.add_argument("fleets", type=Path, metavar="FLEET", help=f"the fleet's: {RUN_HELP}")
    parser.add_argument(
        "hosts",
        type=Path,
        nargs="+",
        metavar="HOST",
        help="records that hosts made of their own services (`record` in hosts.toml)",
    )
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="DIR", help="folder of the joined run"
    )


def run(args: argparse.Namespace) -> int:
    """Write the joined run and say what it gained; a run cut short leaves no file."""
    console = Console()
    fleets = RunIndex(args.fleets)
    records = [host_record(fleets, RunIndex(path)) for path in args.hosts]
    out = make_out(args.out, "join")
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("joining", total=1.0)
        gained = join(fleets, records, out, lambda done: progress.update(task, completed=done))
    count = sum(gained.values())
    console.print(
        f"{printable(str(out / FIRST))}: {count} messages that the fleet's record had not",
        soft_wrap=True,
    )
    for key, number in sorted(gained.items()):
        console.print(f"  {printable(key)}: {number}", highlight=False)
    return 0
