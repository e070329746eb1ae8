"""`xrl log recover`: writes a finished copy of an unfinished log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from shared.mcap_log import recover
from shared.mcap_log.files import in_use, recovered_name
from tools.flags import Flags, option, positional
from tools.guarded_streams import printable
from tools.logs.run_index import head_of
from tools.output import refuse_taken
from tools.terminal import Console, marked

EXAMPLES: Final = """
xrl log recover out/a/run.mcap
"""


class RecoverFlags(Flags):
    """Log to recover, and path of the copy."""

    file: Annotated[Path, positional("FILE")]
    """MCAP file"""
    out: Annotated[Path | None, option("-o", "--out", metavar="OUT")] = None
    """path of the recovered file (default: NAME.recovered.mcap beside FILE)"""
    force: bool = False
    """replace existing files"""


def run(flags: RecoverFlags) -> int:
    """Recover the log; return 0 even if there is nothing to recover."""
    console = Console()
    path = flags.file
    if flags.out is None and recover.is_whole(path):
        console.print(
            f"{printable(str(path))}: finished, whole and indexed; nothing to recover",
            soft_wrap=True,
        )
        return 0
    out = flags.out or recovered_name(path)
    refuse_taken(out, path, force=flags.force)
    if in_use(path):
        console.print("a recorder is writing this file: later messages are not in the copy")
    outcome = recover.recover(path, out)
    console.print(marked("[bold]{}[/]: a finished file", out), soft_wrap=True)
    for line in recover.describe(outcome):
        console.print(f"  {line}", soft_wrap=True)
    flush_ms = head_of(path).get("recorder", {}).get("flush_ms", "")
    if not outcome.finished and flush_ms:
        console.print(
            f"  the recorder wrote every {printable(flush_ms)} ms: messages after its last write "
            "are lost",
            soft_wrap=True,
        )
    return 0
