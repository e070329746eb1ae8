"""`xrl log join`: the fleet's record and those of single hosts become one run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from rich.progress import Progress

from shared.mcap_log.files import FIRST
from tools.flags import RUN_HELP, Flags, option, positional
from tools.guarded_streams import printable
from tools.live.experiment import make_out
from tools.logs.joined_records import host_record, join
from tools.logs.run_index import RunIndex
from tools.terminal import Console

EXAMPLES: Final = """
xrl log join out/body out/left out/right --out out/joined
xrl log resim out/joined
"""


class JoinFlags(Flags):
    """Which records, and where the run goes."""

    fleets: Annotated[Path, positional("FLEET", help=f"the fleet's: {RUN_HELP}")]
    hosts: Annotated[tuple[Path, ...], positional("HOST")]
    """records that hosts made of their own services (`record` in hosts.toml)"""
    out: Annotated[Path, option("-o", "--out", metavar="DIR")]
    """folder of the joined run"""


def run(flags: JoinFlags) -> int:
    """Write the joined run and say what it gained; a run cut short leaves no file."""
    console = Console()
    fleets = RunIndex(flags.fleets)
    records = [host_record(fleets, RunIndex(path)) for path in flags.hosts]
    out = make_out(flags.out, "join")
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("joining", total=1.0)
        gained = join(fleets, records, out, lambda done: progress.update(task, completed=done))
    count = sum(gained.values())
    console.print(
        f"{printable(str(out / FIRST))}: {count} messages that the fleet's record did not have",
        soft_wrap=True,
    )
    for key, number in sorted(gained.items()):
        console.print(f"  {printable(key)}: {number}", highlight=False)
    return 0
