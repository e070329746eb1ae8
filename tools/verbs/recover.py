"""`xrl log recover`: give a log that was never finished its end."""

from __future__ import annotations

import argparse
from pathlib import Path

from shared.exceptions import RunError
from shared.mcap_log import recover
from shared.mcap_log.files import in_use, recovered_name
from tools.guarded_streams import printable
from tools.logs.run_index import MetadataByName, head_of
from tools.terminal import Console, marked
from tools.verb_table import Subparsers, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "recover",
        """
        xrl log recover out/a/run.mcap
        xrl log recover out/a/run.mcap -o rescued.mcap
        """,
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="an MCAP file; it is not touched")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="OUT",
        help="where the recovered file goes (default: NAME.recovered.mcap beside it)",
    )
    parser.add_argument("--force", action="store_true", help="replace OUT if it exists")


def run(args: argparse.Namespace) -> int:
    """Recover it; 0 also if it lacks nothing."""
    console = Console()
    path: Path = args.file
    if args.out is None and recover.is_whole(path):
        console.print(
            f"{printable(str(path))}: finished, whole and indexed; nothing to recover",
            soft_wrap=True,
        )
        return 0
    out: Path = args.out or recovered_name(path)
    if out.exists() and path.exists() and out.samefile(path):
        raise RunError(f"{out}: is the file itself, which stays as it is; give another -o")
    if out.exists() and not args.force:
        raise RunError(f"{out}: exists already; remove it, give another with -o, or --force")
    if _in_use(path):
        console.print("a recorder is writing this file: what follows is not in the copy")
    outcome = recover.recover(path, out)
    console.print(marked("[bold]{}[/]: a finished file", out), soft_wrap=True)
    for line in recover.describe(outcome):
        console.print(f"  {line}", soft_wrap=True)
    flush_ms = _head(path).get("recorder", {}).get("flush_ms", "")
    if not outcome.finished and flush_ms:
        console.print(
            f"  the recorder wrote every {printable(flush_ms)} ms: what came after its last write "
            "is lost",
            soft_wrap=True,
        )
    return 0


def _in_use(path: Path) -> bool:
    try:
        return in_use(path)
    except OSError:
        return False


def _head(path: Path) -> MetadataByName:
    try:
        return head_of(path)
    except RunError:
        return {}
