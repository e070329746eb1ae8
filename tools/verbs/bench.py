"""`xrl bench`: measures the CPU time of each part of the fleet on this machine.

`xrl bench bus` and `xrl bench fleet` measure the bus and the whole fleet. Absolute times on a busy
machine mean little. To compare two versions, use `--against`, which runs both in turn, or compare
each figure's ratio to the yardstick in the same table.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Final

from shared.config import files as config_file
from shared.config import gain_schedule, scenarios
from shared.extras import require
from tools.lab.bench import bus as bus_bench
from tools.lab.bench import fleet as fleet_bench
from tools.lab.bench.parts import ASLEEP_S, FIGURES, SWEPT_BYTES, YARDSTICK_CALLS, Bench
from tools.lab.bench.table import AgainstFlags, finish, row_of, run_turns
from tools.live.experiment import scenario_file
from tools.terminal import Console

EXAMPLES: Final = """
xrl bench
xrl bench --against HEAD~1
xrl bench --rounds 25 --json bench.json
xrl bench bus --transport zenoh --transport datagrams --seconds 30
xrl bench fleet --against HEAD~1 --rounds 5 --json fleet.json
"""

bus, fleet = bus_bench.run, fleet_bench.run


def run(flags: AgainstFlags) -> int:
    """Measure and print; with --strict, a missed target returns the exit code of a fault."""
    require("sim")
    robot = config_file.load(flags.config)
    gain_schedule.require(robot, flags.config)
    console = Console()
    with ExitStack() as stack:
        squat = scenarios.load(scenario_file("squat"))
        bench = Bench(robot, squat, stack) if flags.against is None else None
        here, there = run_turns(
            flags, ["bench"], flags.rounds or 9, lambda: bench.turn() if bench else {}, console
        )
    note = (
        "Each figure is the calling thread's CPU time: the median of the rounds' medians. Cold: "
        f"before each call, {SWEPT_BYTES >> 20} MiB are written and the thread sleeps for "
        f"{1e3 * ASLEEP_S:g} ms. Yardstick: {YARDSTICK_CALLS} solutions of a 12 x 12 system in "
        "NumPy."
    )
    return finish(flags, [row_of(figure, here, there) for figure in FIGURES], note, console)
