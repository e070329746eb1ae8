"""Offsets one row of the pose's reference, live or in lockstep, and takes down the answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from services.planner.intents import OperatorRequest
from services.planner.law.kinematics import Kinematics
from services.planner.law.model import BodyInertia
from services.planner.law.probe import NO_ROW
from services.simulator.physics.plant import PlantConfig
from shared.arrays import Array
from shared.bus import topics
from shared.bus.messages import Message, PlannerMode, PlannerStatus
from shared.bus.session import Session
from shared.bus.topics import Topic
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from shared.exceptions import RunError
from shared.robot.robot_model import stand_pose
from tools.bringup.tune.excitation import Excitation
from tools.fleet.led_planner import LedPlanner
from tools.sim.lockstep import Lockstep, begin_standing

DIRECTIONS: Final = ("x", "y", "z", "roll", "pitch", "yaw")
"""Rows of p."""
ASK_S: Final = 0.01


class ProbeCourse(NamedTuple):
    """What reference and robot did."""

    t_s: Array
    """Since the excitation began (n,), s."""
    r: Array
    """Offset of the reference (n,), m or rad."""
    y: Array
    """The robot's displacement from where it stood (n,), m or rad."""
    ended: str = ""
    """Why it ended before its time; "" if it did not."""


def course_from(
    t_s: Sequence[float], r: Sequence[float], y: Sequence[float], ended: str = ""
) -> ProbeCourse:
    """Return a course from where reference and robot were at first, m or rad."""
    at, asked, moved = (np.array(part, float) for part in (t_s, r, y))
    return ProbeCourse(at, asked - asked[:1], moved - moved[:1], ended)


def course_of(statuses: list[PlannerStatus], row: int, ended: str = "") -> ProbeCourse:
    """Return the course of a row of p in the statuses of an excitation."""
    begin = statuses[0].t_ns if statuses else 0
    t_s = [(status.t_ns - begin) / NS_PER_S for status in statuses]
    r, y = ([getattr(status, name)[row] for status in statuses] for name in ("p_ref", "p"))
    return course_from(t_s, r, y, ended)


class ProbedLockstep(Lockstep):
    """A stand whose reference is probed."""

    row: int = NO_ROW
    excitation: Excitation | None = None

    def _request(self) -> OperatorRequest:
        wanted, t_s = super()._request(), self.world.scenario_s
        if self.excitation is None or t_s < 0.0:
            return wanted
        return wanted._replace(probe_row=self.row, probe=self.excitation.offset(t_s))


def in_lockstep(
    robot: RobotConfig,
    row: int,
    excitation: Excitation,
    plant: PlantConfig,
    progress: Callable[[float], None],
) -> ProbeCourse:
    """Return what a robot on a plant does in virtual time with a row of its reference offset."""
    scenario = Scenario(
        name="tune", about="one reference is offset", duration=excitation.duration_s,
        keyframe=(Keyframe(at=0.0, height=robot.simulation.stand_height),),
    )  # fmt: skip
    statuses: list[PlannerStatus] = []

    def record(topic: Topic, _module: str, message: Message) -> None:
        if topic is topics.PLANNER_STATUS and fleet.world.scenario_s >= 0.0:
            assert isinstance(message, PlannerStatus)  # noqa: S101 - by its topic
            statuses.append(message)

    fleet = ProbedLockstep(robot, scenario, record=record, plant=plant)
    fleet.row, fleet.excitation = row, excitation
    begin_standing(fleet)  # or on the hoist, where it is never led: that is told below
    for truth in fleet.run():
        progress(max(0.0, truth.scenario_s))
        if truth.fallen:
            raise RunError("the robot fell in lockstep; its response cannot be measured")
    left = [status for status in statuses if status.mode != PlannerMode.LEADING]
    if not statuses or left:
        why = left[0].why if left else "the planner never led"
        raise RunError(f"in lockstep the planner stopped leading: {why}")
    return course_of(statuses, row)


class LiveProbe:
    """A robot that is up."""

    def __init__(self, session: Session) -> None:
        """Meet the robot."""
        self._planner = LedPlanner(session, "tune")

    def go(
        self,
        row: int,
        excitation: Excitation,
        progress: Callable[[float], None],
        stopped: Callable[[], bool],
    ) -> ProbeCourse:
        """Probe a row of p; whatever ends it, the probe ends."""
        statuses: list[PlannerStatus] = []

        def ask(t_s: float) -> None:
            self._planner.ask(probe_row=row, probe=excitation.offset(t_s))
            progress(t_s)

        def listen() -> None:
            if self._planner.listen() and self._planner.status.probe_row == row:
                statuses.append(self._planner.status)

        ended = self._planner.lead(excitation.duration_s, ask, listen, stopped, every_s=ASK_S)
        self._planner.ask()
        return course_of(statuses, row, ended)


def inertia_along(robot: RobotConfig, row: int) -> float:
    """Return the inertia of the body along a row of p at the stand, kg or kg m^2; no rotors."""
    q = np.array(stand_pose(robot, robot.simulation.stand_height))
    kinematics = Kinematics(robot)
    kinematics.update(q)
    both = np.vstack([kinematics.J, kinematics.C])
    T = np.asarray(np.linalg.solve(both, np.eye(12, 6)), float)
    return float(BodyInertia(robot).at(q, T)[row, row])
