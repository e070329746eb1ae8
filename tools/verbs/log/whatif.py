"""`xrl log whatif`: kills a service at each moment of a recorded run, and reports the falls."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import msgspec
from rich.text import Text

from services.simulator.physics.plant import PlantConfig
from shared.atomic_file import replace_file
from shared.bus.topics import SIM_STATE
from shared.config import scenarios
from shared.config.scenarios import Scenario
from shared.exceptions import FELL_EXIT_CODE, RunError
from shared.extras import require
from shared.joints import MODULES
from shared.toml_file import Range, parse_toml
from tools.flags import FINITE_MAX, RUN_HELP, Arg, Count, Duration, Folder, option, positional
from tools.judge.run_parts import PartFlags, read_asked
from tools.lab.studies.counterfactual import (
    Counterfactual,
    Task,
    counterfactual_of,
    draw,
    moments_of,
)
from tools.lab.studies.sweeps.pool import cores, results
from tools.lab.studies.sweeps.study import bar
from tools.live.experiment import PLANT_FILE
from tools.logs.hand_path import hand_path
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, refuse_own_controller, robot_of, text_of
from tools.terminal import Console, marked

STATE_EVERY_S: Final = 1.0 / SIM_STATE.rate_hz - 1e-9
"""Period at which the simulated world's state is recorded, less a margin for rounding, s."""
KILLABLE: Final = ("planner", *MODULES)
WIDTH: Final = 72
"""Characters per line of the strip."""


EXAMPLES: Final = """
xrl log whatif out/a/run.mcap --kill planner
xrl log whatif out/a/run.mcap --kill planner --kill knee_left --every 0.6 --for 6
"""


class WhatIfFlags(PartFlags):
    """Services to kill, and when."""

    log: Annotated[Path, positional("RUN", help=RUN_HELP)]
    kill: Annotated[
        tuple[str, ...],
        Arg(
            metavar="SERVICE",
            choices=KILLABLE,
            help="planner or a module, such as knee_left; repeatable: all are killed together",
        ),
    ]
    every: Annotated[float, Range(STATE_EVERY_S, FINITE_MAX, "s"), Arg(metavar="S")] = 0.2
    """time between two kills, to within 0.1 s; at least 0.2 s, the period of the recorded states"""
    for_s: Annotated[Duration, option("--for", metavar="S")] = 4.0
    """duration of each continued run, with pushes and hand as recorded"""
    workers: Annotated[Count | None, Arg(metavar="N")] = None
    """processes on this machine (default: one per core)"""
    out: Folder | None = None
    """folder for whatif.json and whatif.png (default: beside the log)"""


def run(flags: WhatIfFlags) -> int:
    """Continue the run from every moment; return 0 if the robot would have stood each time."""
    require("sim")
    console = Console()
    log = read_asked(flags, RunIndex(flags.log), as_sent=True)
    refuse_own_controller(log)
    robot, scenario = robot_of(log), scenario_of(log)
    kill = tuple(dict.fromkeys(flags.kill))
    moments = [moment for moment in moments_of(log, robot, flags.every) if moment.runs(kill)]
    if not moments:
        raise RunError(
            f"{' and '.join(kill)}: did not run in this part; give another --from or --to"
        )
    true_plant = _plant_of(log)
    led = hand_path(log)
    tasks = [
        Task(robot, scenario, true_plant, moment, kill, flags.for_s, led) for moment in moments
    ]
    counterfactuals: list[Counterfactual] = []
    text = "{task.completed} of {task.total} moments, {task.fields[fell]} fell"
    with bar(text, console) as progress:
        shown = progress.add_task("", total=len(tasks), fell=0)
        for _, counterfactual in results(
            counterfactual_of,
            tasks,
            flags.workers or cores(),
            lambda task: f"{task.moment.at_s:g} s",
        ):
            counterfactuals.append(counterfactual)
            fell = sum(not one.stood for one in counterfactuals)
            progress.update(shown, advance=1, fell=fell)
    counterfactuals.sort(key=lambda one: one.at_s)
    out = flags.out or log.files[0].parent
    out.mkdir(parents=True, exist_ok=True)
    names = " and ".join(kill)
    content = msgspec.json.encode({"kill": kill, "for_s": flags.for_s, "fates": counterfactuals})
    replace_file(out / "whatif.json", msgspec.json.format(content))
    title = f"{names} killed at each moment"
    draw(log, counterfactuals, title, flags.every, out / "whatif.png")
    show(counterfactuals, names, flags.for_s, console)
    console.print(f"{out}/whatif.json, whatif.png", style="dim")
    return 0 if all(one.stood for one in counterfactuals) else FELL_EXIT_CODE


def scenario_of(log: RunLog) -> Scenario:
    """Return the scenario of a run.

    Raises:
        RunError: the log does not contain it.
    """
    where = f"{log.path}: scenario.toml"
    scenario = parse_toml(text_of(log, "scenario.toml"), where, Scenario)
    scenarios.check(str(log.path), scenario)
    return scenario


def _plant_of(log: RunLog) -> PlantConfig:
    """Return the plant that a run was simulated with.

    Raises:
        RunError: the log does not contain it.
    """
    return parse_toml(text_of(log, PLANT_FILE), f"{log.path}: {PLANT_FILE}", PlantConfig)


def show(counterfactuals: list[Counterfactual], names: str, for_s: float, console: Console) -> None:
    """Print the strip and the worst moments."""
    for begin in range(0, len(counterfactuals), WIDTH):
        row = counterfactuals[begin : begin + WIDTH]
        strip = Text(f"{row[0].at_s:6.1f} s ")
        for one in row:
            strip.append("█" if one.stood else "X", style="green" if one.stood else "red")
        console.print(strip)
    fell = [one for one in counterfactuals if not one.stood]
    worst = max(
        counterfactuals, key=lambda one: (not one.stood, max(one.com_x_max_mm, one.com_y_max_mm))
    )
    console.print(
        f"{names} killed at {len(counterfactuals)} moments at which it ran, each continued for "
        f"{for_s:g} s: "
        f"{len(counterfactuals) - len(fell)} stood, {len(fell)} fell"
    )
    if fell:
        times = ", ".join(f"{one.at_s:.1f}" for one in fell[:20])
        console.print(
            marked("[red]fell[/] when killed at {}{} s", times, " ..." if len(fell) > 20 else "")
        )
    margin = "" if worst.margin is None else f", margin {worst.margin:.2f}"
    console.print(
        f"worst at {worst.at_s:.1f} s: COM up to x {worst.com_x_max_mm:.0f}, "
        f"y {worst.com_y_max_mm:.0f} mm, soles tilt {worst.sole_tilt_max_rad:.3f} rad{margin}"
    )
