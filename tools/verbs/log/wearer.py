"""`xrl log wearer`: measures a wearer's park thresholds from a log and writes the wearer file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import msgspec
import tomli_w

from shared.atomic_file import replace_file
from tools.flags import RUN_HELP, positional
from tools.judge.run_parts import PartFlags, read_asked
from tools.judge.wearer import thresholds_of
from tools.logs.run_index import RunIndex
from tools.logs.run_log import robot_of
from tools.terminal import Console

ABOUT: Final = """
Record a minute with park off: stand, squat three times without a stop, and rest in a crouch. The
wearer file lab.wearer.toml is read with the robot file lab.toml beside it."""

EXAMPLES: Final = """
xrl log wearer out/anna/run.mcap
xrl log wearer out/anna/run.mcap --from 10 --to 70 --out deploy/robot.wearer.toml
"""


class WearerFlags(PartFlags):
    """Run to measure, and path of the wearer file."""

    log: Annotated[Path, positional("RUN", help=RUN_HELP)]
    out: Path | None = None
    """wearer file to write (default: only print the thresholds)"""


def run(flags: WearerFlags) -> int:
    """Measure, show and write."""
    log = read_asked(flags, RunIndex(flags.log))
    found = thresholds_of(log, robot_of(log))
    console = Console()
    text = tomli_w.dumps(msgspec.to_builtins(found.thresholds))
    console.print(text, end="", markup=False, highlight=False)
    for line in found.why:
        console.print(line, style="dim", soft_wrap=True)
    for line in found.doubts:
        console.print(line, style="yellow", soft_wrap=True)
    if flags.out is not None:
        reasons = "".join(f"# {line}\n" for line in (f"from {flags.log.name}", *found.why))
        replace_file(flags.out, (reasons + text).encode())
        console.print(f"{flags.out}: written", style="dim")
    return 0
