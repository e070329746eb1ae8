"""One counterfactual: from a moment of a run on, with something dead in it."""

from __future__ import annotations

from typing import Final

import msgspec

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Kill, Scenario
from tools.lab.studies.counterfactual.moments import Moment
from tools.logs.hand_path import HandRow
from tools.sim.lockstep import FleetMoment, Lockstep
from tools.sim.network import BASE

KILL_AFTER_S: Final = 1e-3


class Task(msgspec.Struct, frozen=True):
    """Task of a worker."""

    robot: RobotConfig
    scenario: Scenario
    plant: PlantConfig
    moment: Moment
    kill: tuple[str, ...]
    for_s: float
    """Duration of the continued run, s."""
    hand: tuple[HandRow, ...] = ()
    """How somebody led the hand in the run."""


class Counterfactual(msgspec.Struct, frozen=True):
    """What would have come of it."""

    at_s: float
    """Scenario time of the kill."""
    stood: bool
    fell_after_s: float | None
    com_x_max_mm: float
    """Largest distance from between the ankles, standing."""
    com_y_max_mm: float
    sole_tilt_max_rad: float
    margin: float | None
    """Margin of the failsafe certificate at the kill; None: none was published."""


def scenario_from(scenario: Scenario, at_s: float, kill: tuple[str, ...], for_s: float) -> Scenario:
    """Return the scenario from a time on: its pushes and faults from then, and these kills.

    A lasting fault that began before goes on from the first instant for the rest of its time.
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
    """Go on from the moment, and judge."""
    moment = task.moment
    scenario = scenario_from(task.scenario, moment.at_s, task.kill, task.for_s)
    fleet = Lockstep(task.robot, scenario, BASE, plant=task.plant, hand=task.hand)
    fleet.resume(FleetMoment(moment.state, moment.modules, moment.planner))
    fell_at_s = None
    rows: list[SimTruth] = []
    for truth in fleet.run():
        if truth.fallen:
            fell_at_s = truth.scenario_s
            break
        rows.append(truth)
    return Counterfactual(
        at_s=moment.at_s,
        stood=fell_at_s is None,
        fell_after_s=None if fell_at_s is None else fell_at_s - moment.at_s,
        com_x_max_mm=1e3 * max((abs(row.over[0]) for row in rows), default=0.0),
        com_y_max_mm=1e3 * max((abs(row.over[1]) for row in rows), default=0.0),
        sole_tilt_max_rad=max(
            (max(row.foot_right_tilt, row.foot_left_tilt) for row in rows), default=0.0
        ),
        margin=moment.margin,
    )
