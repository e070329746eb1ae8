"""Counterfactuals of a recorded run: the outcome if services had died at some moment."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, TypeVar

import msgspec
import numpy as np

from services.joint.drive_manager import DriveManagerState
from services.planner.planner import PlannerState
from services.simulator.physics.plant import PlantConfig
from shared.bus import topics
from shared.bus.messages import PlannerStatus
from shared.bus.traces import SimState
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Kill, Scenario
from shared.exceptions import RunError
from shared.joints import MODULES
from shared.state import copied
from tools.lab.studies.sweeps.figures import sole_tilt_max_rad, until_fall
from tools.logs.hand_path import HandRow
from tools.logs.reexecution.compare import ReexecutionResult
from tools.logs.reexecution.joint import JointExecution
from tools.logs.reexecution.planner import PlannerExecution
from tools.logs.run_log import RunLog
from tools.output import new_figure, save_figure
from tools.sim.lockstep import FleetMoment, Lockstep
from tools.sim.network import BASE

R = TypeVar("R")
T = TypeVar("T")

EARLY_S: Final = 0.5 / topics.SIM_STATE.rate_hz
"""Maximum time by which a state may precede its due moment, s."""
NEAR_NS: Final = 12 * NS_PER_MS
"""A service counts as dead at a moment if its last cycle is older than this."""
KILL_AFTER_S: Final = 1e-3
STOOD, FELL = "#2e7d32", "#c0392b"


class Moment(msgspec.Struct):
    """The complete state of a fleet at one time of a run."""

    state: SimState
    modules: dict[str, DriveManagerState] = msgspec.field(default_factory=dict)
    """State of each joint service that was alive."""
    planner: tuple[int, PlannerState] | None = None
    """Session and state of the planner, if it was alive."""
    margin: float | None = None
    """Margin of the failsafe certificate, as last published."""

    @property
    def at_s(self) -> float:
        """Scenario time."""
        return self.state.scenario_s

    def runs(self, services: Sequence[str]) -> bool:
        """Return True if at least one of these services (planner, modules) runs at this moment."""
        return any(
            self.planner is not None if name == "planner" else name in self.modules
            for name in services
        )


def moments_of(log: RunLog, robot: RobotConfig, every_s: float) -> list[Moment]:
    """Return the moments of a run's scenario, at a given interval.

    Joint services and planner are re-executed from the log, so their states are exact to the last
    bit.

    Raises:
        RunError: the run contains no states of the simulated world.
    """
    states: list[SimState] = log.messages(topics.SIM_STATE)
    found = []
    due_s = 0.0
    for state in states:
        if state.scenario_s >= max(0.0, due_s - EARLY_S):
            found.append(Moment(state))
            due_s = every_s * (1 + math.floor((state.scenario_s + EARLY_S) / every_s))
    if not found:
        raise RunError(
            f"{log.path}: contains no states of the simulated world (sim/state). Simulated runs of "
            "this version contain one every 0.2 s of the scenario; a real robot's runs contain none"
        )
    for name in MODULES:
        joint = JointExecution(robot, name, ReexecutionResult(name, 0.0, exact=False))
        rows = ((message.t_ns, joint) for _, message in joint.run(log))
        for moment, snapshot in _at(found, rows, lambda execution: copied(execution.snapshot())):
            if snapshot is not None:
                moment.modules[name] = snapshot
    planner = PlannerExecution(robot, ReexecutionResult("planner", 0.0, exact=False))
    ticks = ((m.t_ns, planner) for _, m in planner.run(log) if isinstance(m, PlannerStatus))
    for moment, known in _at(found, ticks, PlannerExecution.snapshot):
        moment.planner = known
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    published = ((status.t_ns, status) for status in statuses)
    for moment, margin in _at(found, published, lambda status: status.margin):
        moment.margin = margin
    return found


def _at(
    moments: Sequence[Moment], rows: Iterable[tuple[int, R]], kept: Callable[[R], T]
) -> Iterator[tuple[Moment, T]]:
    """Yield each moment with the result of `kept` for the last row before it, if that is near.

    Rows come in order with their times; a row is valid only until the next row.
    """
    index = 0
    last: list[T] = []
    for t_ns, row in rows:
        while index < len(moments) and t_ns > moments[index].state.t_ns:
            yield from ((moments[index], value) for value in last)
            last = []
            index += 1
        if index == len(moments):
            return
        if moments[index].state.t_ns - t_ns <= NEAR_NS:
            last = [kept(row)]
    if index < len(moments):
        yield from ((moments[index], value) for value in last)


class Task(msgspec.Struct, frozen=True):
    """Input of a worker process."""

    robot: RobotConfig
    scenario: Scenario
    plant: PlantConfig
    moment: Moment
    kill: tuple[str, ...]
    for_s: float
    """Duration of the continued run, s."""
    hand: tuple[HandRow, ...] = ()
    """Recorded motion of the simulated hand, if a person led it."""


class Counterfactual(msgspec.Struct, frozen=True):
    """Outcome of a counterfactual."""

    at_s: float
    """Scenario time of the kill."""
    stood: bool
    fell_after_s: float | None
    com_x_max_mm: float
    """Largest distance of the COM from midway between the ankles while standing, mm."""
    com_y_max_mm: float
    sole_tilt_max_rad: float
    margin: float | None
    """Margin of the failsafe certificate at the kill; None if none was published."""


def scenario_from(scenario: Scenario, at_s: float, kill: tuple[str, ...], for_s: float) -> Scenario:
    """Return the scenario from a time on: its later pushes and faults, and these kills.

    A lasting fault that began earlier continues at once for its remaining time.
    """
    lasting = (
        msgspec.structs.replace(fault, at=at_s, duration=fault.at + fault.lasts_s - at_s)
        for fault in scenario.fault
        if fault.at < at_s < fault.at + fault.lasts_s
    )
    return msgspec.structs.replace(
        scenario,
        duration=at_s + for_s,
        kill=tuple(Kill(service=name, at=at_s + KILL_AFTER_S) for name in kill),
        restart=(),
        push=tuple(push for push in scenario.push if push.at + push.duration > at_s),
        fault=(*lasting, *(fault for fault in scenario.fault if fault.at >= at_s)),
    )


def counterfactual_of(task: Task) -> Counterfactual:
    """Continue from the moment, and judge the outcome."""
    moment = task.moment
    scenario = scenario_from(task.scenario, moment.at_s, task.kill, task.for_s)
    fleet = Lockstep(
        task.robot, scenario, BASE, plant=task.plant, hand=task.hand, planner_beside=True
    )
    fleet.resume(FleetMoment(moment.state, moment.modules, moment.planner))
    rows = until_fall(fleet.run())
    fell = rows.pop() if rows and rows[-1].fallen else None
    return Counterfactual(
        at_s=moment.at_s,
        stood=fell is None,
        fell_after_s=None if fell is None else fell.scenario_s - moment.at_s,
        com_x_max_mm=1e3 * max((abs(row.over[0]) for row in rows), default=0.0),
        com_y_max_mm=1e3 * max((abs(row.over[1]) for row in rows), default=0.0),
        sole_tilt_max_rad=sole_tilt_max_rad(rows) if rows else 0.0,
        margin=moment.margin,
    )


def draw(
    log: RunLog, counterfactuals: Sequence[Counterfactual], title: str, every_s: float, path: Path
) -> None:
    """Draw the outcomes over the recorded height to a PNG file."""
    truth = [row for row in log.messages(topics.SIM_TRUTH) if row.scenario_s >= 0.0]
    figure = new_figure(11, 7.0)
    height, ended, com, margin = figure.subplots(
        4, 1, sharex=True, gridspec_kw={"height_ratios": [1.6, 0.4, 1.6, 1.2]}
    )
    height.plot([row.scenario_s for row in truth], [row.torso[2] for row in truth], lw=1.1)
    height.set_ylabel("torso height as recorded, m", fontsize=8)
    for one in counterfactuals:
        colour = STOOD if one.stood else FELL
        ended.axvspan(one.at_s, one.at_s + every_s, color=colour, lw=0)
    ended.set_yticks([])
    ended.set_ylabel("outcome", fontsize=8, rotation=0, ha="right", va="center")
    at = np.array([one.at_s for one in counterfactuals])
    com.plot(at, [one.com_x_max_mm for one in counterfactuals], ".-", ms=4, lw=0.8, label="x")
    com.plot(at, [one.com_y_max_mm for one in counterfactuals], ".-", ms=4, lw=0.8, label="y")
    com.set_ylabel("largest COM, mm", fontsize=8)
    com.legend(loc="upper right", fontsize=8, ncols=2)
    known = [(one.at_s, one.margin) for one in counterfactuals if one.margin is not None]
    if known:
        margin.plot(*zip(*known, strict=True), ".-", ms=4, lw=0.8)
    margin.axhline(0.0, color=FELL, lw=0.8, ls="--")
    margin.set_ylabel("certificate's margin", fontsize=8)
    margin.set_xlabel("scenario time of the kill, s")
    for axis in (height, com, margin):
        axis.grid(visible=True, lw=0.3, color="#bbbbbb")
        axis.tick_params(labelsize=8)
    for event in log.messages(topics.RUN_EVENT):
        if event.scenario_s > 0.0 and event.t_ns < truth[-1].t_ns + NS_PER_S:
            height.axvline(event.scenario_s, color="#7f7f7f", lw=0.6, ls=":")
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    save_figure(figure, path)
