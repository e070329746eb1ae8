"""`xrl study heat`: a pose held until its motors get warm: nobody falls, nothing derates unseen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np
from rich.table import Table as Printed

from services.joint.differential import motor_torque
from services.joint.heat import HeatEstimate
from services.planner.law.kinematics import Kinematics
from shared.bus.messages import LEFT_MAX_S
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.exceptions import FAULT_EXIT_CODE, RunError
from shared.joints import MODULES, kind_of
from shared.robot.robot_model import stand_pose
from tools.flags import Count
from tools.lab.studies.sweeps import heat_picture, heat_trial, plants, study
from tools.lab.studies.sweeps.figures import Ending, exit_code, with_payload
from tools.lab.studies.sweeps.heat_trial import INSULATION, HeatResult, HeatTrial
from tools.lab.studies.sweeps.report import parted, show_falls, show_share
from tools.lab.studies.sweeps.study import AloneFlags, CaseLog, Finished, Study
from tools.lab.studies.sweeps.table import Row
from tools.live import experiment
from tools.terminal import Console

EXAMPLES: Final = """
xrl study heat --poses
xrl study heat --poses --out out/held
xrl study heat --n 30
xrl study heat --only 4 --out out/heat4
"""

POSES: Final = (
    ("straight", 1.25, 0.0, 0.0), ("stand", 1.188, 0.0, 0.0), ("half a squat", 1.07, 0.0, 0.0),
    ("squat", 0.948, 0.0, 0.0), ("deep squat", 0.85, 0.0, 0.0), ("crawl", 0.79, 1.2, 0.0),
    ("stand, 200 N", 1.188, 0.0, 200.0), ("squat, 200 N", 0.948, 0.0, 200.0),
    ("crawl, 200 N", 0.79, 1.2, 200.0),
)  # fmt: skip
"""Name, torso's height, m, pitch, rad, and assist, N."""
PICTURE: Final = "held.png"
DAYS: Final = (("20 C", 20.0, 1.0), ("45 C", 45.0, 1.0), ("45 C, payload +20 %", 45.0, 1.2))
"""Heading, air, C, and the payload's scale."""


class HeatStudyFlags(AloneFlags):
    """How many, or only how long each pose can be held."""

    n: Count = 30
    """trials"""
    poses: bool = False
    """print only how long each pose can be held, by the robot file; with --out draw a squat that is
    held until the robot stands up by itself"""

    def check(self) -> None:
        """Refuse two things at once."""
        super().check()
        if self.poses and self.only is not None:
            raise RunError("--poses runs no trial; leave --only out")


class Held(NamedTuple):
    """How long a pose can be held, and why no longer."""

    seconds: float
    module: str
    """The one that gets too warm first."""
    amperes: float
    """Current of its warmer motor."""


def held(robot: RobotConfig, height: float, pitch: float, assist: float) -> Held:
    """Return how long a pose can be held, from motors as warm as the air.

    Args:
        robot: with the air in `heat.ambient`.
        height: of the torso, m.
        pitch: of the torso, rad.
        assist: N.
    """
    q = np.array(stand_pose(robot, height))
    for index, module in enumerate(MODULES):
        if kind_of(module) == "hip":
            q[2 * index + 1] += pitch
    kinematics = Kinematics(robot)
    kinematics.update(q)
    tau = robot.total_mass * GRAVITY * kinematics.J[2] + assist * kinematics.J_harness[2]
    found = []
    for index, module in enumerate(MODULES):
        pair = (float(tau[2 * index]), float(tau[2 * index + 1]))
        a, b = motor_torque(pair, robot.joint.gear_ratio)
        estimate = HeatEstimate(robot)
        estimate.state.load = (a * a, b * b)
        estimate.skip(0.0)
        amperes = max(abs(a), abs(b)) / robot.drive.torque_constant
        found.append(Held(estimate.state.left_s, module, amperes))
    return min(found, key=lambda one: (one.seconds, -one.amperes))


def show_poses(robot: RobotConfig, console: Console) -> None:
    """Print how long each pose can be held."""
    title = f"How long a pose can be held: windings to {robot.heat.winding_max:g} C"
    printed = Printed(title=title, title_justify="left")
    for heading in ("pose", "torso", *(day for day, _, _ in DAYS), "limited by"):
        printed.add_column(heading, no_wrap=True)
    for name, height, pitch, assist in POSES:
        cells, why = [], ""
        for _, ambient, scale in DAYS:
            warm = msgspec.structs.replace(robot.heat, ambient=ambient)
            day = with_payload(robot, scale * robot.mass.payload)
            found = held(msgspec.structs.replace(day, heat=warm), height, pitch, assist)
            cells.append(describe(found.seconds))
            why = why or f"{found.module.partition('_')[0]}, {found.amperes:.0f} A"
        printed.add_row(name, f"{height:g} m", *cells, why)
    console.print(printed)


def describe(seconds: float) -> str:
    """Return how long a pose can be held, in words."""
    if seconds >= LEFT_MAX_S:
        return "an hour or more"
    return f"{seconds / 60.0:.1f} min"


def load(flags: HeatStudyFlags) -> RobotConfig:
    """Return the robot, if it says what its motors are."""
    robot = experiment.load_robot(flags.config)
    if not robot.heat.estimate:
        raise RunError(f"{flags.config}: heat.estimate = false: nothing is known of its motors")
    return robot


def _cases(flags: HeatStudyFlags, _robot: RobotConfig) -> Callable[[int], HeatTrial]:
    return lambda number: heat_trial.draw(flags.seed, number)


def wrong_with(row: Row) -> str:
    """Return the fault of a row that stood, as text; empty: none."""
    if row["unseen"]:
        return "a drive derated and nobody was told"
    if row["winding_max"] > INSULATION:
        return f"a winding got {row['winding_max']:.0f} C"
    return ""


def trial_exit_code(rows: Sequence[Row]) -> int:
    """Return the exit code of a table: a fall before all else.

    A plant whose load is beyond `law.load_correction` is not led: it holds no squat.
    """
    code = exit_code(row["ending"] for row in rows if row["ending"] is not Ending.UNREADY)
    return code or (FAULT_EXIT_CODE if any(map(wrong_with, rows)) else 0)


def report(finished: Finished) -> None:
    """Print what came of the study."""
    rows, console = finished.rows, finished.console
    standing, others = parted(rows)
    fallen = [row for row in others if row["ending"] is not Ending.UNREADY]
    show_poses(finished.robot, console)
    show_falls(
        fallen, finished.command, lambda row: f"{row['person']}: trial {row['number']}", console
    )
    printed = Printed("what", "least", "median", "largest", "")
    printed.title, printed.title_justify = "Standing trials", "left"
    for key, words, unit in (
        ("held_s", "held until it stood up by itself", "s"),
        ("told_s", "told before that", "s"),
        ("rose_s", "until it was straight", "s"),
        ("winding_max", "warmest winding, true", "C"),
        ("stage_max", "warmest output stage, true", "C"),
        ("derating_min", "of a current limit left", "1"),
        ("error", "estimate less truth as it acts", "K"),
        ("operator_peak_n", "hand's force from then on", "N"),
        ("com_mm", "COM from then on", "mm"),
    ):
        values = [row[key] for row in standing if row[key] is not None]
        if values:
            cells = (min(values), float(np.median(values)), max(values))
            printed.add_row(words, *(f"{value:.3g}" for value in cells), unit)
    console.print(printed)
    lasting = sum(row["held_s"] is None for row in standing)
    why = "light enough, or relieved in time"
    console.print(f"{lasting} of {len(rows)} stood up for no heat: {why}")
    unled = len(others) - len(fallen)
    if unled:
        console.print(f"{unled} plants were not led: loaded otherwise than the law carries")
    for row in standing:
        if wrong := wrong_with(row):
            console.print(f"trial {row['number']}: {wrong}", style="red", highlight=False)
    show_share(len(fallen), max(1, len(rows) - unled), console)


def _metadata(_trial: HeatTrial, command: str) -> dict[str, str]:
    return {"lockstep": command}


STUDY: Final = Study[HeatTrial](
    name="heat",
    case="trial",
    table="trials.csv",
    code=("tools.lab.studies.sweeps.heat_trial",),
    load=load,
    cases=_cases,
    decided_by=("seed",),
    inputs=lambda _flags: {"ranges": plants.digest()},
    row=heat_trial.row_of,
    figures=HeatResult,
    trial=heat_trial.run_trial,
    log=CaseLog(heat_trial.scenario_of, heat_trial.plant_of, _metadata),
    fell=lambda row: row["ending"] not in (Ending.STOOD, Ending.UNREADY),
    report=report,
    exit_code=trial_exit_code,
)


def run(flags: HeatStudyFlags) -> int:
    """Print the table of the poses, or run the study, or one case of it."""
    if flags.poses:
        robot, console = load(flags), Console()
        show_poses(robot, console)
        if flags.out is not None:
            flags.out.mkdir(parents=True, exist_ok=True)
            heat_picture.draw(robot, flags.out / PICTURE)
            console.print(f"{flags.out}/{PICTURE}", style="dim", soft_wrap=True)
        return 0
    return study.run(STUDY, flags)
