"""Measures on request, in a process of its own: `python -m tools.lab.bench.worker CONFIG`.

It runs with the source tree in whose folder it is started. `xrl bench --against` starts one in each
of two trees and lets them measure in turn, some tenths of a second each: a shared machine may be
twice as slow from one minute to the next.

Reads one `Request` a line, answers each with one `Answer`; ends with its input.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import msgspec

from shared.arguments import FlagParser
from shared.config import files as config_file
from shared.config import scenarios
from tools.lab.bench import parts
from tools.lab.bench.timing import Cost, Repeated, measure, yardstick_us
from tools.live.experiment import scenario_file

FIRST_CALLS: Final = 50
"""Before a part is timed for the first time."""


class Request(msgspec.Struct, frozen=True):
    """What to measure: a part, or with no calls a speed of lockstep."""

    name: str
    cold: bool = False
    calls: int = 0


READY: Final = Request("")
"""Answered as soon as all is prepared."""


class Answer(msgspec.Struct, frozen=True):
    """One of `cost`, `speed` and `missing`, beside the yardstick of the same instant."""

    yardstick_us: float
    cost: Cost | None = None
    speed: float | None = None
    """Speed of lockstep, times real time."""
    missing: str = ""
    """Why this tree cannot run the part as the bench needs it."""

    @property
    def value(self) -> float | None:
        """CPU time of a call in the median, us, or the speed."""
        return self.cost.cpu.p50 if self.cost is not None else self.speed


class Bench:
    """Parts of one tree, prepared once."""

    def __init__(self, config: Path, stack: ExitStack) -> None:
        """Run a squat in virtual time and prepare every part with what it met."""
        robot, squat = config_file.load(config), scenarios.load(scenario_file("squat"))
        recorded = parts.record(robot, squat)
        self._parts: dict[str, Repeated] = {}
        self._missing: dict[str, str] = {}
        for part in parts.PARTS:
            try:
                self._parts[part.name] = part.prepare(recorded, stack)
                measure(self._parts[part.name], FIRST_CALLS, cold=False)
            except Exception as error:  # noqa: BLE001 - another revision may differ in any way
                self._missing[part.name] = f"{type(error).__name__}: {error}"
        self._runs = {
            parts.LOCKSTEP: parts.LockstepRun(robot, squat, stack, recorded=False),
            parts.LOCKSTEP_RECORDED: parts.LockstepRun(robot, squat, stack, recorded=True),
        }

    def answer(self, request: Request) -> Answer:
        """Measure."""
        yardstick = yardstick_us()
        if request == READY:
            return Answer(yardstick)
        if request.name in self._runs:
            return Answer(yardstick, speed=self._runs[request.name].speed())
        if request.name in self._missing:
            return Answer(yardstick, missing=self._missing[request.name])
        cost = measure(self._parts[request.name], request.calls, cold=request.cold)
        return Answer(yardstick, cost=cost)


def main() -> int:
    """Answer requests until the input ends."""
    parser = FlagParser(description=__doc__)
    parser.add_argument("config", type=Path)
    arguments = parser.parse_args()
    decode = msgspec.json.Decoder(Request).decode
    with ExitStack() as stack:
        bench = Bench(arguments.config, stack)
        for line in sys.stdin:
            sys.stdout.write(msgspec.json.encode(bench.answer(decode(line))).decode() + "\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
