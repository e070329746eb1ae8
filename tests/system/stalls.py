"""A machine that stalls for longer than a command may be old makes drop-outs that are no fault.

The robot stands, but after each the planner waits for longer: a scenario that begins once all six
have tracked for a second may then never begin.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from shared import topics
from shared.joints import MODULES
from shared.messages import Mode
from tools.runs.run_log import read_run

NEVER_READY: Final = "not all six modules track after"
"""Said by whoever leads the fleet, with exit code 2."""


def stalled_before_it_began(code: int, said: str, out: Path) -> bool:
    """Return True if the machine did not let a live run begin; a fleet that never tracked is amiss.

    Args:
        code: exit code.
        said: everything that was printed.
        out: where the records are, at any depth.
    """
    words = " ".join(said.split())
    return code == 2 and NEVER_READY in words and any(map(_has_tracked, out.rglob("*.mcap")))


def _has_tracked(record: Path) -> bool:
    log = read_run(record)
    return all(
        any(event.mode_after == Mode.TRACK for event in log.messages(topics.JOINT_EVENT, module))
        for module in MODULES
    )
