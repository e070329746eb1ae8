"""Computes the certified gain schedule of each robot of a study.

It depends on the payload and takes seconds: one for each robot, over processes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import msgspec

from shared.config import gain_schedule
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.extras import require
from tools.lab.design import split_program
from tools.lab.studies.sweeps import pool

Progress = Callable[[int, int], None]
"""Receives the number of finished schedules, and of all."""
Task: TypeAlias = "tuple[int, RobotConfig]"


def prepare(
    robots: Sequence[RobotConfig], workers: int, progress: Progress = lambda _done, _of: None
) -> list[RobotConfig]:
    """Return the robots in the same order, each with a schedule that fits it if it uses one.

    Raises:
        RunError: a robot has no local gains that meet the certificate; says which.
        MissingPackageError: a schedule is to be computed, and there is no CVXPY.
    """
    ready = list(robots)
    tasks = [(index, robot) for index, robot in enumerate(robots) if needs_schedule(robot)]
    if tasks:
        require("design")
    progress(0, len(tasks))
    solved = pool.results(_solve, tasks, workers, _name)
    for done, ((index, robot), schedule) in enumerate(solved, start=1):
        ready[index] = msgspec.structs.replace(robot, gain_schedule=schedule)
        progress(done, len(tasks))
    return ready


def needs_schedule(robot: RobotConfig) -> bool:
    """Return True if the robot's gain split uses a schedule and its own does not fit."""
    return robot.law.split == "certified" and bool(gain_schedule.why_stale(robot))


def _solve(task: Task) -> GainSchedule:
    robot = task[1]
    shipped = robot.gain_schedule
    # damping and coupling hardly depend on the payload, and their search takes minutes
    design = None if shipped is None else split_program.design_of(shipped)
    return split_program.solve(robot, design=design, check=False)


def _name(task: Task) -> str:
    return f"gain schedule with a payload of {task[1].mass.payload:g} kg"
