"""`xrl start`: start a service that is down, or continue one that is stopped."""

from __future__ import annotations

from typing import Annotated, Final

from tools.flags import RunDirFlags, positional
from tools.fleet.supervise import SupervisedFleet

EXAMPLES: Final = """
xrl start planner       # after `xrl up --no-planner`: it leads once all six are ready
xrl start knee_left     # at once, even if the supervisor waits after several failures
"""


class StartFlags(RunDirFlags):
    """Which service."""

    service: Annotated[str, positional("SERVICE")]
    """a name that `xrl status` shows"""


def run(flags: StartFlags) -> int:
    """Start it."""
    runs = SupervisedFleet.attach(flags.run_dir).start_service(flags.service)
    if runs is not None:
        print(f"{flags.service}: runs already, as process {runs}; nothing was done")
    else:
        print(f"{flags.service}: started; `xrl status` shows its state")
    return 0
