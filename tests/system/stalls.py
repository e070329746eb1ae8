"""A machine that stalls for longer than a command may be old makes drop-outs that are no fault.

The robot stands, but after each the planner waits for longer: a scenario that begins once all six
have tracked for a second may then never begin. A test is let off only where the stall was measured,
by a thread of a process that does nothing else (`tools.fleet.stalls`).
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

from shared.bus import topics
from shared.bus.messages import Mode
from shared.clock import NS_PER_S
from shared.exceptions import FAULT_EXIT_CODE
from shared.joints import MODULES
from tools.fleet.stalls import StallWatch
from tools.logs.run_log import read_run

NEVER_READY: Final = "not all six modules track after"
"""Said by whoever leads the fleet, with exit code 2."""
LONGEST_RUN_NS: Final = 200 * NS_PER_S
FILE_VARIABLE: Final = "XRL_TEST_STALLS"
"""Where the watch of this session writes."""


def start_watch() -> None:
    """Watch for stalls until this process ends."""
    handle, path = tempfile.mkstemp(prefix="xrl-stalls-")
    os.close(handle)
    atexit.register(Path(path).unlink)
    os.environ[FILE_VARIABLE] = path
    subprocess.Popen([sys.executable, "-m", __name__, path, str(os.getpid())])


def watch(path: Path, parent: int) -> None:
    """Append the end of each stall, ns, until the parent exits."""
    with StallWatch() as own, path.open("a") as file:
        while os.getppid() == parent:
            time.sleep(0.1)
            for stall in own.take():
                file.write(f"{stall.end_ns}\n")
            file.flush()


def has_stalled(since_ns: int) -> bool:
    """Return True if the machine stalled, measured, since a time of the monotonic clock.

    Where no watch runs nothing was measured.
    """
    path = os.environ.get(FILE_VARIABLE)
    return path is not None and any(int(at) >= since_ns for at in Path(path).read_text().split())


def stalled_before_it_began(code: int, said: str, out: Path) -> bool:
    """Return True if the machine stalled and did not let a live run begin.

    A fleet that never tracked, or that did not begin although nothing stalled, is at fault.

    Args:
        code: exit code.
        said: everything that was printed.
        out: where the records are, at any depth.
    """
    words = " ".join(said.split())
    if code != 2 or NEVER_READY not in words:
        return False
    tracked = any(map(_has_tracked, out.rglob("*.mcap")))
    return tracked and has_stalled(time.monotonic_ns() - LONGEST_RUN_NS)


def stood(code: int, out: Path) -> bool:
    """Return True if a led robot stood, and soundly unless a measured stall made modules hold.

    A hand that leads on against HOLD keeps motors at their limits, and the planner waits for longer
    before it leads again than the verdict judges apart.

    Args:
        code: exit code of the verb.
        out: where its `summary.json` is.
    """
    if code == 0:
        return True
    summary = json.loads((out / "summary.json").read_text())
    held = any(row["modules_held"] for row in summary["stalls"])
    return code == FAULT_EXIT_CODE and bool(summary["unsound"]) and held


def _has_tracked(record: Path) -> bool:
    log = read_run(record)
    return all(
        any(event.mode_after == Mode.TRACK for event in log.messages(topics.JOINT_EVENT, module))
        for module in MODULES
    )


if __name__ == "__main__":
    watch(Path(sys.argv[1]), int(sys.argv[2]))
