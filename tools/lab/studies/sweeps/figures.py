"""Shared code of the studies: a run in virtual time, the rows that count, endings, figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum
from typing import Any, Final, NamedTuple, Protocol

import msgspec

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import HandLead, JointEvent, Message, Mode
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE
from shared.extras import late
from tools.judge.standing import why_not_standing
from tools.lab.studies.sweeps.table import Row
from tools.sim.lockstep import Lockstep, Watch, forget
from tools.sim.virtual_services import Record

stats = late("scipy.stats")

END_TOLERANCE_S: Final = 0.1


class Observer(NamedTuple):
    """Callbacks of a run; the defaults do nothing."""

    record: Record = forget
    """Receives every message."""
    watch: Watch = lambda _row: None
    """Receives every row of the world, including those that do not count."""
    after_fall_s: float = 0.0
    """Time for which the trial continues after a fall, s; the measurement ends at the fall."""


NOBODY: Final = Observer()


class Case(Protocol):
    """A drawn case: everything that determines its run, besides the robot."""

    @property
    def number(self) -> int:
        """Its number, from 0."""

    def scenario(self, robot: RobotConfig) -> Scenario:
        """Return the case as a scenario."""

    def true_plant(self) -> PlantConfig:
        """Return the simulated robot."""


def ignore(_fleet: Lockstep, _row: SimTruth) -> None:
    """Do nothing with a row of the world."""


class CaseRun(NamedTuple):
    """The part of a run that counts, until its end or the fall."""

    rows: Sequence[SimTruth]
    events: Sequence[tuple[str, JointEvent]]
    """Changes of mode, with their modules."""
    messages: Sequence[tuple[str, Message]]
    """Messages of the requested types, with their modules."""

    @property
    def began(self) -> bool:
        """False if the scenario never started: the robot fell first, or not all modules tracked."""
        return bool(self.rows) and self.rows[0].scenario_s >= 0.0

    def ended(self, end_s: float, robot: RobotConfig) -> dict[str, Any]:
        """Return the figures of `Ended`; the planned end `end_s` is in scenario time."""
        if not self.rows:
            return {"ending": Ending.UNREADY}
        last = self.rows[-1]
        fell_at_s = last.scenario_s if last.fallen and self.began else None
        return {"ending": ending_of(last, end_s, robot), "fell_at_s": fell_at_s}


def run_fleet(
    case: Case,
    robot: RobotConfig,
    observer: Observer,
    network: Impairment,
    *,
    seed: int,
    from_s: float = 0.0,
    kept: tuple[type[Message], ...] = (),
    fleet_type: type[Lockstep] = Lockstep,
    each: Callable[[Lockstep, SimTruth], None] = ignore,
) -> CaseRun:
    """Run a case in virtual time to its end or to the fall.

    Rows before the scenario time `from_s` are dropped, except that of a fall. The network applies
    to every link, in addition to the scenario's own impairments. Messages of the types `kept` are
    returned. `each` receives every row before the observer.
    """
    messages: list[tuple[str, Message]] = []

    def record(topic: Topic, module: str, message: Message) -> None:
        if isinstance(message, kept):
            messages.append((module, message))
        observer.record(topic, module, message)

    scenario, plant = case.scenario(robot), case.true_plant()
    fleet = fleet_type(robot, scenario, network, seed=seed, record=record, plant=plant)
    rows = list[SimTruth]()
    for row in fleet.run():
        each(fleet, row)
        observer.watch(row)
        if rows and rows[-1].fallen:
            if row.scenario_s > rows[-1].scenario_s + observer.after_fall_s:
                break
        elif row.fallen or row.scenario_s >= from_s:
            rows.append(row)
    end_ns = rows[-1].t_ns if rows else 0
    return CaseRun(
        rows,
        [row for row in fleet.events if row[1].t_ns <= end_ns],
        [row for row in messages if row[1].t_ns < end_ns],
    )


class ReactingPerson:
    """A hand that stops some time after the wearer is told that the robot holds.

    `xrl cue` tells the wearer. A scripted hand keeps leading, like a person who notices nothing.
    """

    def __init__(self, reacts_s: float) -> None:
        """Store the time from the cue to the stop, s; people need 0.2 to 0.4."""
        self._reacts_s = reacts_s
        self._stops_s: float | None = None
        self._stopped = False

    def __call__(self, fleet: Lockstep, row: SimTruth) -> None:
        """Check a row of the world, and stop the hand when the time is up."""
        if self._stopped or row.scenario_s < 0.0:
            return
        if self._stops_s is None:
            holds = any(one.failsafe.mode is not Mode.TRACK for one in fleet.controllers)
            self._stops_s = row.scenario_s + self._reacts_s if holds else None
        elif row.scenario_s >= self._stops_s:
            self._stopped = True
            fleet.lead(
                HandLead(
                    t_ns=0, seq=0, leads=True, height=row.torso[2], pitch=row.angles[1],
                    push=(0.0, 0.0, 0.0), source="person",
                )
            )  # fmt: skip


def until_fall(run: Iterable[SimTruth]) -> list[SimTruth]:
    """Run to the end, or to the fall, which is then the last row."""
    rows = list[SimTruth]()
    for row in run:
        rows.append(row)
        if row.fallen:
            break
    return rows


class Ending(StrEnum):
    """Outcome of a case."""

    STOOD = "stood"
    FELL = "fell"
    TIPPING = "tipping"
    """Not fallen at the end, but about to fall: a sole has lifted, the COM is beyond the soles, or
    the torso has turned."""
    UNREADY = "unready"
    """The robot stands, but not all six modules tracked, so the scenario did not start."""


class Ended(msgspec.Struct, frozen=True, kw_only=True):
    """The first figures of every result."""

    ending: Ending
    fell_at_s: float | None = None
    """Scenario time."""

    @property
    def stood(self) -> bool:
        """True if the robot stood to the end."""
        return self.ending == Ending.STOOD


EXIT_CODES: Final = {
    Ending.STOOD: 0,
    Ending.FELL: FELL_EXIT_CODE,
    Ending.TIPPING: FELL_EXIT_CODE,
    Ending.UNREADY: FAULT_EXIT_CODE,
}
"""A robot that tips counts as fallen."""


def worst(codes: Iterable[int]) -> int:
    """Return the exit code of many cases: a fall takes precedence, then a fault."""
    return max(codes, key=lambda code: (code == FELL_EXIT_CODE, code), default=0)


def ending_of(last: SimTruth, end_s: float, robot: RobotConfig) -> Ending:
    """Return the outcome of a case from its last row that counts and its planned end, s."""
    if last.fallen or last.scenario_s < end_s - END_TOLERANCE_S:
        return Ending.FELL
    return Ending.TIPPING if why_not_standing(last, robot) else Ending.STOOD


def com_max_mm(rows: Sequence[SimTruth]) -> float:
    """Return the largest horizontal distance of the COM from midway between the ankles, mm."""
    return 1e3 * max(math.hypot(*row.over) for row in rows)


def operator_peak_n(rows: Sequence[SimTruth]) -> float:
    """Return the hand's largest vertical force, N."""
    return max(abs(row.operator_force[2]) for row in rows)


def sole_tilt_max_rad(rows: Sequence[SimTruth]) -> float:
    """Return the largest tilt of a sole, rad."""
    return max(max(row.foot_right_tilt, row.foot_left_tilt) for row in rows)


def scalars(case: msgspec.Struct) -> dict[str, object]:
    """Return the draws of a case that each fill one column."""
    values = msgspec.structs.asdict(case)
    return {name: value for name, value in values.items() if not isinstance(value, tuple)}


def step_nm(before: Sequence[float], after: Sequence[float]) -> float:
    """Return the largest change of a joint's torque, N m."""
    return max(abs(b - a) for a, b in zip(before, after, strict=True))


def event_steps_nm(events: Iterable[JointEvent]) -> list[float]:
    """Return the step of torque at each change of mode, N m."""
    return [step_nm(event.tau_before, event.tau_after) for event in events]


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a fraction that was observed in trials (E. B. Wilson, 1927).

    The trials must be independent. The interval is for one fraction: among several intervals, the
    worst is wrong more often than once in 20.
    """
    interval = stats.binomtest(hits, of).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def parted(rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    """Return the cases that stood to the end, and the other cases."""
    standing = [row for row in rows if row["ending"] == Ending.STOOD]
    return standing, [row for row in rows if row["ending"] != Ending.STOOD]
