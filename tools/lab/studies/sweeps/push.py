"""`xrl study push`: the largest withstood push by direction, duration, pose and mode, by bisection.

The robot stands up and is led to the pose. For the mode `dead` the planner is then killed. All
pushes of the bisection start from the same saved state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import Annotated, Any, Final

import msgspec
from rich.table import Table

from services.planner.law.split import ScheduledGains
from services.simulator.physics.plant import PlantConfig, plant_from
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Scenario
from shared.exceptions import RunError
from tools.flags import Arg, Degrees, Duration
from tools.lab.design.push_limit import PushLimits, limits_along
from tools.lab.studies.sweeps import study
from tools.lab.studies.sweeps.figures import NOBODY, Ending, Observer, ending_of, until_fall
from tools.lab.studies.sweeps.plants import torso_at
from tools.lab.studies.sweeps.study import FALL_COLOUR, Study, StudyFlags, StudyRun
from tools.lab.studies.sweeps.table import Row
from tools.live.experiment import PlantFlags
from tools.output import Picture, new_figure
from tools.sim.lockstep import FleetMoment, Lockstep
from tools.sim.network import BASE

POSES: Final = {"stand": (1.188, 0.0), "squat": (0.95, 0.0), "crawl": (0.79, 1.2)}
"""Torso height, m, and pitch, rad."""
MODES: Final = ("led", "dead")
"""The planner leads, or is dead."""
REACHED_S: Final = 2.5
"""Scenario time at which the pose is reached."""
LEFT_S: Final = 3.5
"""Scenario time of the planner's kill."""
BEGIN_S: Final = 4.5
"""Scenario time at which the push begins."""
REST_S: Final = 2.0
"""Time after the push within which a robot that will fall has fallen, or is tipping, s."""
FORCE_MAX_N: Final = 240.0
STEP_N: Final = 5.0


class PushTrial(msgspec.Struct, frozen=True):
    """A point of the envelope."""

    number: int
    pose: str
    angle_deg: int
    """Direction of the push: 0 forwards, 90 to the left."""
    duration_s: float
    mode: str
    plant: PlantConfig = PlantConfig()

    def scenario(self, _robot: RobotConfig, force_n: float = 0.0) -> Scenario:
        """Return the scenario with a push of this force."""
        height, pitch = POSES[self.pose]
        angle = math.radians(self.angle_deg)
        push = Push(
            at=BEGIN_S,
            duration=self.duration_s,
            force=(force_n * math.cos(angle), force_n * math.sin(angle), 0.0),
        )
        return Scenario(
            name=f"push-{self.number}",
            about=f"{self.pose}, {self.mode}, {force_n:g} N at {self.angle_deg} degrees",
            duration=BEGIN_S + self.duration_s + REST_S,
            keyframe=(
                Keyframe(at=0.0, height=POSES["stand"][0]),
                Keyframe(at=REACHED_S, height=height, pitch=pitch),
            ),
            kill=(Kill(service="planner", at=LEFT_S),) if self.mode == "dead" else (),
            push=(push,) if force_n > 0.0 else (),
        )

    def true_plant(self) -> PlantConfig:
        """Return the simulated robot."""
        return self.plant


class _PushResult(msgspec.Struct, frozen=True, kw_only=True):
    """The withstood push and the static limits."""

    stood_n: float
    """Largest push that the robot withstood, N; 0 if none."""
    fell_n: float | None
    """Smallest push that made it fall, within `STEP_N`, N; None if it withstood all of them."""
    held_limit_n: float
    """Static limit of the gains (`tools.lab.design.push_limit`): those of HOLD, because a led robot
    trips into HOLD unless the push is straight forwards or back."""
    held_part: str
    """The part that sets this limit."""
    body_limit_n: float
    """Static limit of soles and motors in this pose, under any control."""


def run_trial(trial: PushTrial, robot: RobotConfig, _observer: Observer = NOBODY) -> _PushResult:
    """Find the largest withstood push by bisection.

    Raises:
        RunError: the robot does not reach the pose.
    """
    start = _start_of(trial, robot)
    stood, fell = 0.0, FORCE_MAX_N + STEP_N
    while fell - stood > STEP_N:
        force = STEP_N * round(0.5 * (stood + fell) / STEP_N)
        if _stands(trial, robot, start, force):
            stood = force
        else:
            fell = force
    limits = limits_of(trial, robot)
    trips = trial.angle_deg % 180 != 0
    held = limits.led if trial.mode == "led" and not trips else limits.held
    return _PushResult(
        stood_n=stood,
        fell_n=fell if fell <= FORCE_MAX_N else None,
        held_limit_n=held.force_n,
        held_part=held.part,
        body_limit_n=limits.body.force_n,
    )


def limits_of(trial: PushTrial, robot: RobotConfig) -> PushLimits:
    """Return the static limits of the trial's pose and direction, without the plant's errors."""
    schedule = robot.gain_schedule
    if schedule is None:
        raise RunError("the robot has no gain schedule; run `xrl gains`")
    scheduled, (height, pitch) = ScheduledGains(schedule), POSES[trial.pose]
    stand, z = torso_at(robot, height, pitch)
    angle = math.radians(trial.angle_deg)
    direction = (math.cos(angle), math.sin(angle))
    return limits_along(stand, robot, scheduled.at(z, pitch), scheduled.D_B, direction)


def _start_of(trial: PushTrial, robot: RobotConfig) -> FleetMoment:
    fleet = Lockstep(robot, trial.scenario(robot), BASE, plant=trial.plant)
    for truth in fleet.run():
        if truth.fallen:
            raise RunError(f"{trial.pose}: the robot fell before it was pushed")
        if truth.scenario_s >= BEGIN_S - 0.1:
            break
    if fleet.world.scenario_s < BEGIN_S - 0.1:
        raise RunError(f"{trial.pose}: not all six modules tracked, so no push was tried")
    moment = fleet.moment()
    return moment if trial.mode == "led" else msgspec.structs.replace(moment, planner=None)


def _stands(trial: PushTrial, robot: RobotConfig, start: FleetMoment, force_n: float) -> bool:
    scenario = trial.scenario(robot, force_n)
    fleet = Lockstep(robot, msgspec.structs.replace(scenario, kill=()), BASE, plant=trial.plant)
    fleet.resume(start)
    rows = until_fall(fleet.run())
    return bool(rows) and ending_of(rows[-1], scenario.duration, robot) is Ending.STOOD


ANGLES_DEG: Final = (0, 45, 90, 135, 180)
"""Left and right are symmetric."""
SIDES_DEG: Final = ("0", "45", "90", "135", "180", "-135", "-90", "-45")
"""Labels of the directions, with negative degrees to the right."""
DURATIONS_S: Final = (0.3, 3.0)
SHORT: Final = {"led": "leads", "dead": "dead"}
CURVES: Final = (
    ("led", "stood_n", "#1f5f8b", "-o", "planner leads"),
    ("dead", "stood_n", FALL_COLOUR, "-o", "planner dead"),
    ("dead", "held_limit_n", FALL_COLOUR, "--", "gains of HOLD, constant push"),
    ("dead", "body_limit_n", "black", "--", "soles and motors, constant push"),
)
"""Mode, column, colour, line, label."""


EXAMPLES: Final = """
xrl study push
xrl study push --pose stand --duration 3 --angle 90
xrl study push --plant drivetrain.stiffness=2000 --out out/soft
"""


class PushStudyFlags(StudyFlags, PlantFlags):
    """Points to measure."""

    pose: Annotated[tuple[str, ...], Arg(choices=tuple(POSES))] = ()
    """only this pose; repeatable"""
    angle: Annotated[tuple[Degrees, ...], Arg(metavar="DEG")] = ()
    """direction of the push: 0 forwards, 90 to the left; repeatable (default: 0, 45, 90, 135,
    180)"""
    duration: tuple[Duration, ...] = ()
    """duration of the push; repeatable (default: 0.3, 3)"""

    def check(self) -> None:
        """Refuse --out for a single point, which consists of many runs and has no log."""
        super().check()
        if self.only is not None and self.out is not None:
            raise RunError("--only: a point consists of many runs and has no log; remove --out")


def trials_of(flags: PushStudyFlags) -> list[PushTrial]:
    """Return the selected points."""
    durations = tuple(flags.duration or DURATIONS_S)
    grid = product(flags.pose or POSES, durations, flags.angle or ANGLES_DEG, MODES)
    plant = plant_from(flags.plant)
    return [
        PushTrial(number, pose, angle, duration, mode, plant)
        for number, (pose, duration, angle, mode) in enumerate(grid)
    ]


def row_of(trial: PushTrial) -> dict[str, object]:
    """Return a point by its columns."""
    row = msgspec.structs.asdict(trial)
    del row["plant"]
    return row


def report(finished: StudyRun) -> None:
    """Print the largest withstood pushes by direction, and the part that gives way first."""
    rows = finished.rows
    angles = [f"{angle} deg" for angle in dict.fromkeys(row["angle_deg"] for row in rows)]
    printed = Table(title="Largest push that the robot withstood, N", title_justify="left")
    for heading in ("pose", "s", "planner", *angles, "gives way"):
        printed.add_column(heading, no_wrap=True)
    groups: dict[tuple[str, float, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["pose"], row["duration_s"], row["mode"]), []).append(row)
    for (pose, duration, mode), some in groups.items():
        forces = [f"{row['stood_n']:g}" for row in some]
        weakest = min(some, key=lambda row: float(row["stood_n"]))
        printed.add_row(pose, f"{duration:g}", SHORT[mode], *forces, weakest["held_part"])
    finished.console.print(printed)


def draw(finished: StudyRun) -> Picture:
    """Draw the envelopes, with a panel for each pose and duration; forwards is up."""
    rows = finished.rows
    poses = list(dict.fromkeys(row["pose"] for row in rows))
    durations = list(dict.fromkeys(row["duration_s"] for row in rows))
    figure = new_figure(0.5 + 4.6 * len(poses), 0.8 + 4.6 * len(durations), dpi=100)
    for number, (duration, pose) in enumerate(product(durations, poses)):
        axis: Any = figure.add_subplot(len(durations), len(poses), number + 1, projection="polar")
        axis.set_theta_zero_location("N")
        for mode, column, colour, line, words in CURVES:
            points = sorted(
                (row["angle_deg"], row[column])
                for row in rows
                if (row["pose"], row["duration_s"], row["mode"]) == (pose, duration, mode)
            )
            _draw_curve(axis, points, line, color=colour, label=words, markersize=4)
        axis.set_thetagrids(range(0, 360, 45), SIDES_DEG)
        axis.set_title(f"{pose}, {duration:g} s, N")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.suptitle("Largest withstood push, by direction (up: forwards)", x=0.01, ha="left")
    return figure


def _draw_curve(axis: Any, points: Sequence[tuple[int, float]], line: str, **style: object) -> None:
    """Draw a curve and its mirror image."""
    mirrored = [(-angle, force) for angle, force in reversed(points) if 0 < angle < 180]
    closing = points[:1] if len(points) > 2 else []
    around = [*points, *mirrored, *closing]
    angles = [math.radians(angle) for angle, _ in around]
    axis.plot(angles, [force for _, force in around], line, **style)


STUDY: Final = Study[PushTrial](
    name="push",
    case="point",
    table="pushes.csv",
    total=lambda flags: len(trials_of(flags)),
    cases=lambda flags, _robot: trials_of(flags).__getitem__,
    decided_by=("plant", "pose", "angle", "duration"),
    row=row_of,
    figures=_PushResult,
    trial=run_trial,
    report=report,
    draw=draw,
    exit_code=lambda _row: 0,
)


def run(flags: PushStudyFlags) -> int:
    """Run the study, or one point of it."""
    return study.run(STUDY, flags)
