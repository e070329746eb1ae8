"""Measures one round in a process of its own: `python -m tools.bench.worker CONFIG`.

It runs with the source tree in whose folder it is started, so `xrl bench --against` starts it in
two trees in turn. Prints one JSON object, `Round`.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import msgspec

from shared.config import files as config_file
from shared.config import scenarios
from tools.bench import parts
from tools.bench.timing import Cost, measure, yardstick_us
from tools.runs.experiment import scenario_file

WARM_CALLS: Final = 750
COLD_CALLS: Final = 200


class Round(msgspec.Struct):
    """What one process measured."""

    yardstick_us: float = 0.0
    warm: dict[str, Cost] = {}
    cold: dict[str, Cost] = {}
    speed: dict[str, float] = {}
    """Of lockstep, times real time."""
    missing: dict[str, str] = {}
    """Parts that this tree does not have as the bench needs them, and the error."""


def run_round(config: Path) -> Round:
    """Measure every part once, warm and cold, and lockstep."""
    robot, scenario = config_file.load(config), scenarios.load(scenario_file("squat"))
    done = Round(yardstick_us=yardstick_us())
    recorded = parts.record(robot, scenario)
    for part in parts.PARTS:
        try:
            with ExitStack() as stack:
                repeated = part.prepare(recorded, stack)
                measure(repeated, 50, cold=False)
                done.warm[part.name] = measure(repeated, WARM_CALLS, cold=False)
                done.cold[part.name] = measure(repeated, COLD_CALLS, cold=True)
        except Exception as error:  # noqa: BLE001 - another revision's part may differ in any way
            done.missing[part.name] = f"{type(error).__name__}: {error}"
    for name, kept in ((parts.LOCKSTEP, False), (parts.LOCKSTEP_RECORDED, True)):
        done.speed[name] = parts.lockstep_speed(robot, scenario, recorded=kept)
    return done


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", type=Path)
    arguments = parser.parse_args()
    sys.stdout.write(msgspec.json.encode(run_round(arguments.config)).decode() + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
