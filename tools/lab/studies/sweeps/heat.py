"""`xrl study heat`: a pose held until its motors get warm: nobody falls, nothing derates unseen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.table import Table as Printed

from services.joint.differential import motor_torque
from services.joint.heat import HeatEstimate
from services.planner.law.kinematics import Kinematics
from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import LEFT_MAX_S, HeatAction
from shared.bus.traces import SimTruth
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from shared.exceptions import FAULT_EXIT_CODE, FELL_EXIT_CODE, RunError
from shared.joints import MODULES, kind_of
from shared.robot.robot_model import stand_pose
from tools.flags import Count
from tools.lab.studies.sweeps import heat_trial, plants, study
from tools.lab.studies.sweeps.figures import Ending, with_payload
from tools.lab.studies.sweeps.heat_trial import (
    AHEAD_S,
    HELD_S,
    INSULATION,
    LEAD_S,
    HeatResult,
    HeatTrial,
)
from tools.lab.studies.sweeps.report import parted, show_falls, show_figures, show_share
from tools.lab.studies.sweeps.study import AloneFlags, CaseLog, Study, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.live import experiment
from tools.output import new_figure, save_figure
from tools.sim.lockstep import Lockstep, begin_standing
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
FIGURES: Final = (
    ("held_s", "held until it stood up by itself", "s"),
    ("told_s", "told before that", "s"),
    ("rose_s", "until it was straight", "s"),
    ("winding_max", "warmest winding, true", "C"),
    ("stage_max", "warmest output stage, true", "C"),
    ("derating_min", "of a current limit left", "1"),
    ("error", "estimate less truth as it acts", "K"),
    ("operator_peak_n", "hand's force from then on", "N"),
    ("com_mm", "COM from then on", "mm"),
)
PICTURE: Final = "held.png"
DAYS: Final = (("20 C", 20.0, 1.0), ("45 C", 45.0, 1.0), ("45 C, payload +20 %", 45.0, 1.2))
"""Heading, air, C, and the payload's scale."""


SQUAT: Final = 0.948
"""m"""
AMBIENT: Final = 35.0
"""C, of the plant; the robot file says what the estimate takes it to be."""
SAMPLE_S: Final = 2.0
"""Skipped time from one sample to the next."""
HELD_PICTURE_S: Final = 75.0
COLOURS: Final = {
    HeatAction.NONE: "#ffffff", HeatAction.EASES: "#fbe3c4", HeatAction.STANDS_UP: "#f2a65a",
    HeatAction.RESTS: "#cfe5d4",
}  # fmt: skip
WORDS: Final = {
    HeatAction.EASES: "told",
    HeatAction.STANDS_UP: "stands up",
    HeatAction.RESTS: "rests",
}


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


def wrong_with(row: Row) -> str:
    """Return the fault of a row that stood, as text; empty: none."""
    if row["unseen"]:
        return "a drive derated and nobody was told"
    if row["winding_max"] > INSULATION:
        return f"a winding got {row['winding_max']:.0f} C"
    return ""


def fell(row: Row) -> bool:
    """Return True for a fall.

    A plant whose load is beyond `law.load_correction` is not led: it holds no squat.
    """
    return row["ending"] not in (Ending.STOOD, Ending.UNREADY)


def exit_code(row: Row) -> int:
    """Return the exit code of a trial."""
    if fell(row):
        return FELL_EXIT_CODE
    return FAULT_EXIT_CODE if wrong_with(row) else 0


def report(finished: StudyRun) -> None:
    """Print what came of the study."""
    rows, console = finished.rows, finished.console
    standing, others = parted(rows)
    fallen = list(filter(fell, others))
    show_poses(finished.robot, console)
    show_falls(
        fallen, finished.command, lambda row: f"{row['person']}: trial {row['number']}", console
    )
    show_figures(standing, FIGURES, {"least": min, "median": median, "largest": max}, console)
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


class HeldMoment(NamedTuple):
    """One moment, skipped time counted."""

    t_s: float
    height: float
    """Height of the torso, m."""
    true: float
    """Warmest winding, C."""
    estimated: float
    left_s: float
    hand: float
    """Vertical force of a hand that stays at the squat, N."""
    action: HeatAction


def samples(robot: RobotConfig) -> Iterator[HeldMoment]:
    """Run a squat held by a hand that clings, on the default plant."""
    frames = (Keyframe(0.0, robot.simulation.stand_height), Keyframe(LEAD_S, SQUAT))
    scenario = Scenario(name="held", about="a squat held", duration=HELD_PICTURE_S, keyframe=frames)
    plant = changed(PlantConfig(), {"heat.ambient": AMBIENT})
    fleet = Lockstep(robot, scenario, plant=plant)
    begin_standing(fleet)
    skipped_s = 0.0

    def sample(row: SimTruth) -> HeldMoment:
        states = [law.heat.state for law in fleet.controllers]
        planner = fleet.planner
        status = None if planner is None else planner.status(fleet.now_ns, 0.0)
        return HeldMoment(
            row.scenario_s + skipped_s, row.torso[2], float(fleet.bank.heat.winding.max()),
            max(max(state.winding) for state in states), min(state.left_s for state in states),
            row.operator_force[2], HeatAction(0 if status is None else status.heat),
        )  # fmt: skip

    for number, row in enumerate(fleet.run()):
        if row.scenario_s >= LEAD_S + HELD_S and skipped_s == 0.0:
            until_s = robot.heat.ease_s + AHEAD_S
            while min(law.heat.state.left_s for law in fleet.controllers) > until_s:
                fleet.skip_heat(SAMPLE_S)
                skipped_s += SAMPLE_S
                yield sample(row)
        if number % 20 == 0:
            yield sample(row)


def draw_held(robot: RobotConfig, path: Path) -> None:
    """Draw a held squat into a PNG file: all of it, and the end at a larger scale."""
    rows = list(samples(robot))
    t_s = np.array([row.t_s for row in rows])
    acts = [k for k, row in enumerate(rows) if row.action is not HeatAction.NONE]
    begin_s = t_s[acts[0]] - 10.0 if acts else 0.0
    figure = new_figure(12.0, 6.5)
    grid = figure.subplots(3, 2, sharex="col", sharey="row", height_ratios=(2.2, 1.2, 1.5))
    for column, (t, unit) in enumerate(((t_s / 60.0, "min"), (t_s - begin_s, "s"))):
        _draw_column(grid[:, column], t, rows, robot)
        grid[2, column].set_xlabel(unit)
    grid[0, 1].set_xlim(0.0, t_s[-1] - begin_s)
    labels = ("warmest winding, C", "left at this\nload, s", "torso, m")
    for axis, label in zip(grid[:, 0], labels, strict=True):
        axis.set_ylabel(label)
    grid[1, 0].set_ylim(1.0, 2000.0)
    grid[0, 0].legend(fontsize=8, loc="lower right")
    for number, begin in enumerate(_starts(rows)):
        if rows[begin].action in WORDS:
            y = robot.heat.winding_max + 2.0 + 4.0 * (number % 2)
            words = WORDS[rows[begin].action]
            grid[0, 1].text(t_s[begin] - begin_s + 0.5, y, words, fontsize=8)
    grid[0, 0].set_ylim(top=robot.heat.winding_max + 11.0)
    title = f"A squat at {SQUAT:g} m held by a hand that clings to it, until the robot stands up"
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    save_figure(figure, path)


def _draw_column(
    axes: Sequence[Any], t: NDArray[np.float64], rows: Sequence[HeldMoment], robot: RobotConfig
) -> None:
    temperature, left, height = axes
    temperature.plot(t, [row.estimated for row in rows], color="#c8553d", label="estimated")
    truth = f"true, air {AMBIENT:g} C"
    temperature.plot(t, [row.true for row in rows], color="#1f4e79", label=truth)
    temperature.axhline(robot.heat.winding_max, color="#c0392b", lw=1.0, ls="--", label="limit")
    left.plot(t, [min(row.left_s, 1200.0) for row in rows], color="#444444")
    left.set_yscale("log")
    for limit_s in (robot.heat.ease_s, robot.heat.stand_s):
        left.axhline(limit_s, color="#7f7f7f", lw=0.8, ls=":")
    height.plot(t, [row.height for row in rows], color="#1f4e79")
    force = height.twinx()
    force.plot(t, [row.hand for row in rows], color="#5b8c5a", lw=0.9)
    force.set_ylabel("hand, N", color="#5b8c5a")
    starts = _starts(rows)
    for begin, end in zip(starts, [*starts[1:], len(rows) - 1], strict=True):
        for axis in axes:
            axis.axvspan(t[begin], t[end], color=COLOURS[rows[begin].action], lw=0.0, alpha=0.6)


def _starts(rows: Sequence[HeldMoment]) -> list[int]:
    """Return where each action begins."""
    return [0, *(k for k in range(1, len(rows)) if rows[k].action != rows[k - 1].action)]


STUDY: Final = Study[HeatTrial](
    name="heat",
    case="trial",
    table="trials.csv",
    load=load,
    cases=lambda flags, _robot: partial(heat_trial.draw, flags.seed),
    decided_by=("seed",),
    inputs=lambda _flags: {"ranges": plants.digest()},
    row=heat_trial.row_of,
    figures=HeatResult,
    trial=heat_trial.run_trial,
    log=CaseLog(
        heat_trial.scenario_of,
        heat_trial.plant_of,
        lambda _trial, command: {"lockstep": command},
    ),
    fell=fell,
    report=report,
    exit_code=exit_code,
)


def run(flags: HeatStudyFlags) -> int:
    """Print the table of the poses, or run the study, or one case of it."""
    if flags.poses:
        robot, console = load(flags), Console()
        show_poses(robot, console)
        if flags.out is not None:
            flags.out.mkdir(parents=True, exist_ok=True)
            draw_held(robot, flags.out / PICTURE)
            console.print(f"{flags.out}/{PICTURE}", style="dim", soft_wrap=True)
        return 0
    return study.run(STUDY, flags)
