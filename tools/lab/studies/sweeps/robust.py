"""`xrl study robust`: leads and pushes random plants, kills their planners, and counts falls.

The seed and the number of a trial determine it.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import numpy as np

from services.simulator.physics.plant import PlantConfig, changed
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Scenario
from shared.extras import late
from shared.toml_file import Range
from tools.flags import Arg, Count, Number
from tools.lab.studies.sweeps import plants, study
from tools.lab.studies.sweeps.figures import (
    NOBODY,
    Ended,
    Ending,
    Observer,
    ReactingPerson,
    com_max_mm,
    event_steps_nm,
    ignore,
    operator_peak_n,
    parted,
    run_fleet,
    scalars,
    sole_tilt_max_rad,
)
from tools.lab.studies.sweeps.plants import PushFlags, PushRange, uniform
from tools.lab.studies.sweeps.study import FALL_COLOUR, Study, StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.live import experiment
from tools.live.experiment import ImuFlags
from tools.output import Picture, new_figure

if TYPE_CHECKING:
    from scipy import stats
else:
    stats = late("scipy.stats")

KINDS: Final = ("squat", "crawl", "lean")
DELAY_MAX_MS: Final = 10.0
LEAD_S: Final = 2.0
"""Duration of each half of a squat, s; the crawl takes twice that."""
LEAN_SHARE: Final = (0.15, 0.4)
LEAN_S: Final = 1.5
"""Duration of the long push while the planner leads, s."""
PUSH_SHARE: Final = (0.3, 1.0)
"""Range of the drawn pushes, as fractions of the largest one (`PushRange`)."""
PUSH_S: Final = 0.3
AFTER_KILL_S: Final = 2.5


class RobustTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A trial; seed, number and `beyond` determine the plant."""

    number: int
    seed: int
    beyond: float
    """Factor on the ranges of `deploy/plants/ranges.toml`."""
    slope_deg: float
    """The floor's slope, in a random direction; 0 for a slope from the ranges."""
    kind: str
    kill_s: float
    delay_ms: float
    pushes: tuple[Push, ...]
    reacts_s: float | None = None
    """Time from HOLD until the person stops leading; None if they keep leading."""

    def true_plant(self) -> PlantConfig:
        """Return the trial's simulated robot."""
        seed = f"robust {self.seed} {self.number}"
        plant = plants.draw(seed, beyond=self.beyond)
        if self.slope_deg == 0.0:
            return plant
        angle = uniform(random.Random(f"slope {seed}"), -math.pi, math.pi)
        slope = math.radians(self.slope_deg)
        towards = [round(slope * part, 6) for part in (math.cos(angle), math.sin(angle))]
        return changed(plant, {"floor.slope": towards})

    def scenario(self, robot: RobotConfig) -> Scenario:
        """Return the trial as a scenario."""
        stand = robot.simulation.stand_height
        ways = {
            "crawl": (Keyframe(2.0 * LEAD_S, 0.79, pitch=1.2, assist=robot.assist.force_max),),
            "squat": (Keyframe(LEAD_S, 0.948), Keyframe(2.0 * LEAD_S, stand)),
            "lean": (Keyframe(LEAD_S, 1.05),),
        }
        return Scenario(
            name=f"robust-{self.seed}-{self.number}",
            about=f"trial {self.number} of `xrl study robust --seed {self.seed}`",
            duration=round(self.kill_s + AFTER_KILL_S, 3),
            keyframe=(Keyframe(0.0, stand), *ways[self.kind]),
            kill=(Kill(service="planner", at=self.kill_s),),
            push=self.pushes,
        )


class _RobustResult(Ended, frozen=True, kw_only=True):
    """The figures of a trial; None where nothing was measured."""

    operator_peak_n: float | None = None
    """Vertical force of the hand while the planner leads."""
    com_led_max_mm: float | None = None
    """Largest horizontal distance of the COM from midway between the ankles, led."""
    com_held_max_mm: float | None = None
    """The same after the kill."""
    sole_tilt_max_rad: float | None = None
    hold_step_nm: float | None = None
    """Largest step of a joint's torque at a change of mode after the start."""


def draw(
    pushes: PushRange,
    seed: int,
    number: int,
    beyond: float = 1.0,
    slope_deg: float = 0.0,
    reacts_s: float | None = None,
) -> RobustTrial:
    """Return one trial, which does not depend on any other trial."""
    dice = random.Random(f"robust {seed} {number}")
    kind = KINDS[number % len(KINDS)]
    way = 2.0 * LEAD_S
    kill = uniform(dice, 0.6 * way, 1.2 * way)
    share, lasting = (LEAN_SHARE, LEAN_S) if kind == "lean" else (PUSH_SHARE, PUSH_S)
    led = pushes.draw(dice, share, 1.0, lasting)
    held = pushes.draw(dice, PUSH_SHARE, kill + uniform(dice, 0.2, 0.8), PUSH_S)
    return RobustTrial(
        number=number,
        seed=seed,
        beyond=beyond,
        slope_deg=slope_deg,
        kind=kind,
        kill_s=kill,
        delay_ms=uniform(dice, 0.5, DELAY_MAX_MS),
        pushes=(led, held),
        reacts_s=reacts_s,
    )


def run_trial(trial: RobustTrial, robot: RobotConfig, observer: Observer = NOBODY) -> _RobustResult:
    """Run a trial to its end or to the fall, and measure it."""
    network, end_s = Impairment(delay_ms=trial.delay_ms), trial.scenario(robot).duration
    each = ignore if trial.reacts_s is None else ReactingPerson(trial.reacts_s)
    run = run_fleet(trial, robot, observer, network, seed=trial.number, each=each)
    if not run.began:
        return _RobustResult(**run.ended(end_s, robot))
    led = [row for row in run.rows if row.scenario_s < trial.kill_s]
    held = [row for row in run.rows if row.scenario_s >= trial.kill_s]
    events = [event for _, event in run.events if run.rows[0].t_ns <= event.t_ns]
    return _RobustResult(
        **run.ended(end_s, robot),
        operator_peak_n=operator_peak_n(led),
        com_led_max_mm=com_max_mm(led),
        com_held_max_mm=com_max_mm(held) if held else None,
        sole_tilt_max_rad=sole_tilt_max_rad(run.rows),
        hold_step_nm=max(event_steps_nm(events), default=None),
    )


def row_of(trial: RobustTrial) -> dict[str, object]:
    """Return every draw by its column: first the trial's, then the plant's errors."""
    row = scalars(trial)
    for name, push in zip(("led", "held"), trial.pushes, strict=True):
        row |= {f"push_{name}_x_n": push.force[0], f"push_{name}_y_n": push.force[1]}
    return row | dict(plants.errors_of(trial.true_plant()))


SLOPE_MAX_DEG: Final = 15.0
RANKED_LEAST: Final = 30
"""Minimum number of trials for ranking errors: with fewer a correlation of 0.36 may be chance."""
FIGURES: Final = (
    ("operator_peak_n", "operator's force, led", "N", 1.0),
    ("com_led_max_mm", "COM, led", "mm", 1.0),
    ("com_held_max_mm", "COM, after the kill", "mm", 1.0),
    ("sole_tilt_max_rad", "tilt of a sole", "rad", 1.0),
    ("hold_step_nm", "torque step into or out of HOLD", "N m", 1.0),
)
"""Column, description, unit, and the sign of the worse direction."""

EXAMPLES: Final = """
xrl study robust
xrl study robust --n 500 --out out/robust
xrl study robust --beyond 2
xrl study robust --slope 5 --imu
xrl study robust --reacts 0.3
"""


class RobustStudyFlags(StudyFlags, ImuFlags, PushFlags):
    """Number of trials, and the errors of their plants."""

    n: Count = 100
    """number of trials"""
    beyond: Annotated[Number, Arg(metavar="F")] = 1.0
    """scale every range of deploy/plants/ranges.toml about its middle by F"""
    slope: Annotated[float, Range(0.0, SLOPE_MAX_DEG, "degrees"), Arg(metavar="DEG")] = 0.0
    """slope of the floor, in a random direction (default: up to 1 degree along x and y)"""
    reacts: Annotated[float | None, Range(0.0, 5.0, "s"), Arg(metavar="S")] = None
    """stop leading S seconds after the robot goes to HOLD, like a person whom `xrl cue` warns
    (default: never)"""

    def check(self) -> None:
        """Refuse ranges that give impossible values."""
        super().check()
        plants.draw("check", beyond=self.beyond)


def ranking(rows: Sequence[Row]) -> list[tuple[str, float]]:
    """Return each error with its rank correlation with the COM's excursion, strongest first.

    For errors with both signs the size counts; a trial that fell counts as the farthest.
    """
    far = np.array([_excursion(row) for row in rows])
    found = []
    for error in plants.shipped().error:
        values = np.array([row[error.key] for row in rows])
        size = np.abs(values - 0.5 * (error.low + error.high)) if error.low < 0.0 else values
        if np.ptp(size) > 0.0 and np.ptp(far) > 0.0:
            found.append((error.key, float(stats.spearmanr(size, far).statistic)))
    return sorted(found, key=lambda pair: -abs(pair[1]))


def _excursion(row: Row) -> float:
    """Return the COM's excursion while the planner leads and the robot is pushed, mm."""
    value: float | None = row["com_led_max_mm"]
    return 1e3 if row["ending"] is not Ending.STOOD or value is None else value


def report(finished: StudyRun) -> None:
    """Print the outcome of the study, and the errors that move the COM most."""
    rows = finished.rows
    study.show_outcome(finished, FIGURES, lambda row: f"{row['kind']}: trial {row['number']}")
    if len(rows) < RANKED_LEAST:
        most = f"unknown; ranking needs at least {RANKED_LEAST} trials"
    else:
        most = ", ".join(f"{key} {value:+.2f}" for key, value in ranking(rows)[:5])
    finished.console.print(f"rank correlation with the COM's excursion: {most}", soft_wrap=True)


def draw_excursions(finished: StudyRun) -> Picture:
    """Draw the excursions by the drivetrain's stiffness."""
    flags, rows = finished.flags, finished.rows
    figure = new_figure(9, 6)
    axis = figure.subplots()
    styles = ("stood", "o", "#1f5f8b"), ("fell", "x", FALL_COLOUR)
    for some, (label, marker, colour) in zip(parted(rows), styles, strict=True):
        x = [row["drivetrain.stiffness"] for row in some]
        y = [min(200.0, _excursion(row)) for row in some]
        axis.scatter(x, y, marker=marker, color=colour, s=18, label=label)
    axis.set(xscale="log", xlabel="drivetrain stiffness, N m/rad")
    axis.set_ylabel("COM from midway between the ankles while led, mm (fell: 200)")
    axis.legend()
    title = f"{len(rows)} trials, every error drawn, ranges x{flags.beyond:g}, seed {flags.seed},\n"
    title += f"{plants.describe(flags)}: {len(parted(rows)[1])} fell"
    figure.suptitle(title, x=0.01, ha="left")
    return figure


def _cases(flags: RobustStudyFlags, robot: RobotConfig) -> Callable[[int], RobustTrial]:
    pushes = PushRange(robot, flags.push)
    return lambda number: draw(pushes, flags.seed, number, flags.beyond, flags.slope, flags.reacts)


STUDY: Final = Study[RobustTrial](
    name="robust",
    case="trial",
    table="trials.csv",
    load=lambda flags: experiment.load_robot(flags.config, imu=flags.imu),
    cases=_cases,
    decided_by=("beyond", "slope", "push", "reacts"),
    row=row_of,
    figures=_RobustResult,
    trial=run_trial,
    report=report,
    draw=draw_excursions,
)


def run(flags: RobustStudyFlags) -> int:
    """Run the study, or one trial of it."""
    return study.run(STUDY, flags)
