"""The page of faults: what goes wrong, what then happens, what a person does, from the tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from shared.config.files import load
from shared.config.scenarios import FAULT_KINDS
from shared.config.sections import TripLimit, TripsConfig
from shared.places import DEFAULT_CONFIG
from shared.robot.fault_table import DRIVE_FAULTS, LOSSES
from shared.robot.trip_table import JOINT_TRIPS, PLANNER_TRIPS, TripRow
from tools.dev.reference.markdown import one_line, table

_INTRODUCTION: Final = """\
# Faults

`xrl faults` prints this page's tables. Lockstep tests hold the robot to each row of the first two
tables, and `xrl study crash` does so live. A module that lost torque is never re-armed
automatically, even if its service restarts: a person mends the cause, then restarts the service.

## A fault of a drive

The module goes to FAULT and the planner holds the other five. An axis that disarms floats; its
sibling keeps its torque until the service idles it, at once. To see one:
`xrl sim --fault knee_left:encoder@4`.
"""
_LOSSES: Final = """
## A lost process or link, and the emergency stop
"""
_TRIPS: Final = """
## Trips

A trip takes the robot out of being led: a module, or the planner, notices that a quantity is beyond
its limit, and all six modules go to HOLD. Limits are those of `[trips]` in `deploy/robot.toml`.
"""


def page() -> Iterator[str]:
    """Yield the page in Markdown."""
    yield _INTRODUCTION
    yield from table(
        "fault | what it is | the drive | limp | zero lost | cause | what a person does",
        (
            _cleaned(
                f"`{kind}`", FAULT_KINDS[kind].about, row.drive, "yes" if row.limp else "no",
                "yes" if row.zero_lost else "no",
                f"`{row.cause.name}`" if row.cause else "no FAULT", row.recovery,
            )
            for kind, row in DRIVE_FAULTS.items()
        ),
    )  # fmt: skip
    yield _LOSSES
    losses = (_cleaned(name, *loss) for name, loss in LOSSES.items())
    yield from table("lost | its module, or all six | the others | what you see | recovery", losses)
    yield _TRIPS
    limits = load(DEFAULT_CONFIG).trips
    trips = [(cause.name, "the module", row) for cause, row in JOINT_TRIPS.items()]
    trips += [(number.name, "the planner", row) for number, row in PLANNER_TRIPS.items()]
    yield from table(
        "trip | noticed by | measured | limit | what a person does",
        (
            _cleaned(f"`{name}`", by, row.measured, _limit(row, limits), row.recovery)
            for name, by, row in trips
        ),
    )


def _limit(row: TripRow, limits: TripsConfig) -> str:
    limit: TripLimit = getattr(limits, row.key)
    lasting = f" for {limit.after_ms:g} ms" if limit.after_ms else ""
    return f"{'below' if row.least else 'above'} {limit.limit:g} {row.unit}{lasting}"


def _cleaned(*cells: str) -> Iterator[str]:
    return map(one_line, cells)
