"""`xrl study sweep push`: the hardest push by direction, duration, pose and mode."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Final, TypeAlias

import msgspec
import numpy as np
from rich.table import Table as Printed

from services.simulator.physics import plant as plants
from services.simulator.physics.plant import PlantConfig, plant_from
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from tools.lab.studies.sweeps import study
from tools.lab.studies.sweeps.push_trial import MODES, POSES, PushResult, PushTrial, run_trial
from tools.lab.studies.sweeps.table import Row, code_of
from tools.live import experiment
from tools.number_arguments import degrees, finite
from tools.output import new_figure, save_figure
from tools.terminal import Console
from tools.verb_table import add_config

ANGLES_DEG: Final = (0, 45, 90, 135, 180)
"""Left and right are alike."""
SIDES_DEG: Final = ("0", "45", "90", "135", "180", "-135", "-90", "-45")
"""Degrees of a push to the right."""
DURATIONS_S: Final = (0.3, 3.0)
TABLE: Final = "pushes.csv"
PICTURE: Final = "pushes.png"
CODE: Final = code_of("tools.lab.studies.sweeps.push_trial")
COLOURS: Final = {"led": "#1f5f8b", "dead": "#c0392b"}
SHORT: Final = {"led": "leads", "dead": "dead"}
WORDS_OF: Final = {"led": "planner leads", "dead": "planner dead"}
Task: TypeAlias = "tuple[PushTrial, RobotConfig, PlantConfig]"

EXAMPLES: Final = """
    xrl study sweep push
    xrl study sweep push --pose stand --duration 3 --angle 90
    xrl study sweep push --plant drivetrain.stiffness=2000 --out out/soft
"""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the study's flags."""
    add_config(parser)
    parser.add_argument(
        "--pose", action="append", choices=tuple(POSES), help="only this one; may be repeated"
    )
    parser.add_argument(
        "--angle",
        action="append",
        type=degrees,
        metavar="DEG",
        help="push that way, 0 forwards, 90 to the left; may be repeated (0, 45, 90, 135, 180)",
    )
    parser.add_argument(
        "--duration",
        action="append",
        type=finite,
        metavar="S",
        help="of the pushes; may be repeated (0.3, 3)",
    )
    experiment.add_plant(parser)
    study.add_flags(parser, "push", f"{TABLE} and {PICTURE}")


def run(args: argparse.Namespace) -> int:
    """Run the study; 0 once it is done."""
    executor = study.executor_of(args, CODE)
    robot, plant = experiment.load_robot(args.config), plant_from(args.plant)
    trials = trials_of(args)
    console = Console()
    rows_begin = [msgspec.structs.asdict(trial) for trial in trials]
    columns = [*PushTrial.__struct_fields__, *PushResult.__struct_fields__]
    inputs = study.inputs(
        "push", robot, CODE, plant=plants.to_toml(plant),
        grid=repr([msgspec.structs.astuple(trial) for trial in trials]),
    )  # fmt: skip
    finished = study.run(
        study.Study(
            "push", TABLE, columns, LABELS, inputs, rows_begin, len(trials), JOB, _command(args)
        ),
        lambda done: [(trial, robot, plant) for trial in trials if trial.number not in done],
        args.out, executor, console,
    )  # fmt: skip
    rows = finished.rows
    draw(rows, finished.out / PICTURE)
    _show(rows, console)
    finished.show_files(f"{TABLE}, {PICTURE}", "point", console)
    return 0


def trials_of(args: argparse.Namespace) -> list[PushTrial]:
    """Return the selected points.

    Raises:
        RunError: a duration is not positive.
    """
    durations = tuple(args.duration or DURATIONS_S)
    if min(durations) <= 0.0:
        raise RunError(f"--duration {min(durations):g}: must be more than 0 s")
    grid = product(args.pose or POSES, durations, args.angle or ANGLES_DEG, MODES)
    return [
        PushTrial(number=number, pose=pose, angle_deg=angle, duration_s=duration, mode=mode)
        for number, (pose, duration, angle, mode) in enumerate(grid)
    ]


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the envelopes into a PNG file: a panel for each pose and duration, forwards is up."""
    poses = list(dict.fromkeys(row["pose"] for row in rows))
    durations = list(dict.fromkeys(row["duration_s"] for row in rows))
    size = (0.5 + 4.6 * len(poses), 0.8 + 4.6 * len(durations))
    figure = new_figure(*size, dpi=100)
    for number, (duration, pose) in enumerate(product(durations, poses)):
        axis = figure.add_subplot(len(durations), len(poses), number + 1, projection="polar")
        axis.set_theta_zero_location("N")  # type: ignore[attr-defined]  # of polar axes
        some = [row for row in rows if row["pose"] == pose and row["duration_s"] == duration]
        for mode in MODES:
            points = sorted(
                (int(row["angle_deg"]), float(row["stood_n"]))
                for row in some
                if row["mode"] == mode
            )
            _curve(axis, points, COLOURS[mode], WORDS_OF[mode], "-o")
        dead = [row for row in some if row["mode"] == "dead"]
        for key, colour, words in (
            ("held_limit_n", COLOURS["dead"], "its gains, push lasting"),
            ("body_limit_n", "black", "soles and motors, push lasting"),
        ):
            points = sorted((int(row["angle_deg"]), float(row[key])) for row in dead)
            _curve(axis, points, colour, words, "--")
        axis.set_thetagrids(range(0, 360, 45), SIDES_DEG)  # type: ignore[attr-defined]  # polar
        axis.set_title(f"{pose}, {float(duration):g} s, N")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    figure.suptitle("Hardest push that it stood, by direction (up: forwards)", x=0.01, ha="left")
    save_figure(figure, path)


def _curve(
    axis: object, points: Sequence[tuple[int, float]], colour: str, label: str, style: str
) -> None:
    """Draw a curve and its mirror image."""
    mirrored = [(-angle, force) for angle, force in reversed(points) if 0 < angle < 180]
    both = [*points, *mirrored]
    angles = [math.radians(angle) for angle, _ in both]
    forces = [force for _, force in both]
    closed = len(points) > 2
    axis.plot(  # type: ignore[attr-defined]  # an Axes, whose stub knows no projections
        [*angles, angles[0]] if closed else angles,
        [*forces, forces[0]] if closed else forces,
        style, color=colour, label=label, markersize=4,
    )  # fmt: skip


def _show(rows: Sequence[Row], console: Console) -> None:
    """Print the weakest direction of each pose, duration and mode."""
    printed = Printed(title="Hardest push that it stood, N", title_justify="left")
    for heading in ("pose", "s", "planner", *(f"{a} deg" for a in _angles(rows)), "gives way"):
        printed.add_column(heading, no_wrap=True)
    groups = dict.fromkeys((row["pose"], row["duration_s"], row["mode"]) for row in rows)
    for pose, duration, mode in groups:
        some = [
            row for row in rows
            if (row["pose"], row["duration_s"], row["mode"]) == (pose, duration, mode)
        ]  # fmt: skip
        weakest = some[int(np.argmin([float(row["stood_n"]) for row in some]))]
        printed.add_row(
            pose, duration, SHORT[mode], *(row["stood_n"] for row in some), weakest["held_part"]
        )
    console.print(printed)


def _angles(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["angle_deg"] for row in rows))


def _run_task(task: Task) -> PushResult:
    return run_trial(*task)


def _name(task: Task) -> str:
    trial = task[0]
    return f"{trial.pose}, {trial.angle_deg} degrees, {trial.duration_s:g} s, {trial.mode}"


def _rows(task: Task, outcome: PushResult) -> list[dict[str, object]]:
    return [msgspec.structs.asdict(task[0]) | msgspec.structs.asdict(outcome)]


class _AnyText(frozenset[str]):
    """Every text: of a column that names a part of the robot."""

    def __contains__(self, _: object) -> bool:
        return True


LABELS: Final = {
    "pose": frozenset(POSES),
    "mode": frozenset(MODES),
    "held_part": _AnyText(),
}
JOB: Final = study.Job(_run_task, _name, _rows, lambda _row: False)


def _command(args: argparse.Namespace) -> str:
    """Return the command of this study, but for `--out`."""
    flags = [
        f"--{flag} {value}"
        for flag in ("pose", "angle", "duration", "plant")
        for value in getattr(args, flag) or ()
    ]
    return study.command("push", args, *flags)
