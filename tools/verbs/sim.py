"""`xrl sim`: runs an experiment in virtual time, in one process, reproducible to the last bit."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Final

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from services.planner.controller import controller_maker
from services.simulator.physics.plant import plant_from
from shared.bus import topics
from shared.bus.traces import SimTruth
from shared.config.impairment import Impairment
from shared.exceptions import RunError
from shared.extras import require
from shared.toml_file import Range
from tools.flags import Arg, Folder
from tools.judge import verdict, verdict_table
from tools.judge.figure import judge_run
from tools.live import experiment
from tools.logs.hand_path import HandRow, hand_path
from tools.logs.run_log import read_run
from tools.sim import recorded_lockstep
from tools.sim.centralised import CONTROLS, SHIPPED
from tools.terminal import Console

Milliseconds = Annotated[float, Range(0.0, 1e12, "ms")]

EXAMPLES: Final = """
xrl sim
xrl sim --delay 10 --out out/slow
xrl sim --delay 5 --jitter 5 --loss 0.1 --seed 3
xrl sim --delay 50 --control centralised
xrl sim --plant drivetrain.stiffness=3000 --plant drivetrain.play=0.01
xrl sim --scenario stand --hand out/view/run.mcap     # repeat a person's motion
xrl sim --inject 'all partition at=3 for=2' --inject 'planner->left loss=0.5 at=6'
"""


class _SimFlags(experiment.ExperimentFlags):
    """Experiment to run, its network, and where the torques are computed."""

    delay: Milliseconds = 1.0
    """delay of every link, each way"""
    jitter: Milliseconds = 0.0
    """half the width of the delay's uniform distribution"""
    loss: Annotated[float, Range(0.0, 1.0, ""), Arg(metavar="P")] = 0.0
    """probability that a message is lost"""
    control: Annotated[str, Arg(choices=CONTROLS)] = SHIPPED
    """where torques are computed; centralised, all by the planner, is a baseline"""
    hand: Annotated[Path | None, Arg(metavar="RUN")] = None
    """repeat this record's hand and pushes instead of the scenario's path"""
    out: Folder | None = None
    """folder for the results (default: a new one in out/)"""

    def check(self) -> None:
        """Refuse two controllers."""
        super().check()
        if self.controller is not None and self.control != SHIPPED:
            raise RunError(
                "--controller and --control both choose what computes the torques; remove one"
            )


def run(flags: _SimFlags) -> int:
    """Run the experiment; return 0 only if the robot stood to the end."""
    require("sim")
    console = Console()
    robot, scenario = experiment.make_robot(flags), experiment.make_scenario(flags)
    true_plant = plant_from(flags.plant)
    hand = _path_of(flags.hand) if flags.hand is not None else ()
    if flags.controller is not None:
        controller_maker(flags.controller, robot)  # reject it before anything is written
    network = Impairment(delay_ms=flags.delay, jitter_ms=flags.jitter, loss=flags.loss)
    out = experiment.make_out(flags.out, "sim")
    experiment.introduce(scenario, console)
    bar = Progress(
        BarColumn(), TextColumn("{task.completed:5.1f} of {task.total:g} s"),
        TimeRemainingColumn(), console=console, transient=True,
    )  # fmt: skip
    begin = time.monotonic()
    with bar as progress:
        task = progress.add_task("", total=scenario.duration)

        def watch(truth: SimTruth) -> None:
            progress.update(task, completed=max(0.0, truth.scenario_s))

        try:
            simulated_s = recorded_lockstep.simulate(
                robot, scenario, network, flags.seed, out, watch, flags.control, true_plant, hand,
                flags.controller,
            )  # fmt: skip
        except KeyboardInterrupt:
            console.print(
                f"interrupted; the record up to this point is in {out}; complete its file with "
                "`xrl log recover`",
                soft_wrap=True,
            )
            raise
    factor = simulated_s / (time.monotonic() - begin)
    summary = judge_run(out, f"{scenario.name} in lockstep", scenario.duration, speed=factor)
    verdict_table.show(summary, console)
    console.print(f"{factor:.1f} x real time; {out}/run.mcap, run.png, summary.json", style="dim")
    return verdict.exit_code(summary)


def _path_of(record: Path) -> tuple[HandRow, ...]:
    """Return the path of the hand in a record."""
    log = read_run(record)
    path = hand_path(log)
    if not path and log.messages(topics.OPERATOR_HAND):
        raise RunError(
            f"{record}: no scenario ran while the hand was led; record a run with `xrl demo --view`"
        )
    if not path:
        raise RunError(
            f"{record}: nobody led the hand in it; record a led hand with `xrl demo --view`"
        )
    return path
