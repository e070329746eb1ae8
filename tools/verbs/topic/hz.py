"""`xrl topic hz`: rate, spacing, age and size of topics."""

from __future__ import annotations

from typing import Annotated, Final

from shared.bus.session import open_session
from shared.clock import pace
from shared.exceptions import FAULT_EXIT_CODE
from shared.process import StopFlag
from tools.flags import Duration, RunDirFlags, option, positional
from tools.fleet.process_table import services_elsewhere
from tools.fleet.supervise import SupervisedFleet
from tools.fleet.traffic import LINKS_S, Traffic, traffic_table
from tools.terminal import Console, renewed
from tools.topic_keys import keys_named

WINDOW_S: Final = 1.0


EXAMPLES: Final = """
xrl topic hz 'joint/*/state'            # until Ctrl-C
xrl topic hz planner/status --for 10    # one table over ten seconds
xrl topic hz                            # every topic
"""


class HzFlags(RunDirFlags):
    """Which topics, and how long."""

    topic: Annotated[tuple[str, ...], positional("TOPIC")] = ()
    """such as 'joint/*/state' (default: all)"""
    for_s: Annotated[Duration | None, option("--for")] = None
    """measure for S seconds and print once; exit code 3 if no message came"""


def run(flags: HzFlags) -> int:
    """Measure; time apart and age are median and largest of a window, as received here."""
    keys = keys_named(flags.topic)
    fleet = SupervisedFleet.attach(flags.run_dir)
    robot = fleet.manifest.robot()
    console, stop = Console(), StopFlag()
    with open_session(robot, "hz", fleet.run.path) as session:
        traffic = Traffic(session, keys, services_elsewhere(robot, fleet.run.path))
        traffic.listen(LINKS_S)  # links form: what was waiting has no spacing
        if flags.for_s is not None:
            window_s = traffic.listen(flags.for_s, lambda: bool(stop))
            console.print(traffic_table(traffic, window_s * pace()))
            return 0 if any(one.count for one in traffic.keys.values()) else FAULT_EXIT_CODE
        with renewed(console) as show:
            while not stop:
                window_s = traffic.listen(WINDOW_S, lambda: bool(stop))
                show(traffic_table(traffic, window_s * pace()))
    return 0
