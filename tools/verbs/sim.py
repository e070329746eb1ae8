"""`xrl sim`: the experiment in virtual time: no processes, bit-identical, as fast as it can."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from services.planner.controller_file import controller_maker
from services.simulator.physics.plant import plant_from
from shared.bus import topics
from shared.bus.messages import SimTruth
from shared.config.impairment import Impairment
from shared.exceptions import RunError
from shared.extras import require
from tools.judge import verdict, verdict_table
from tools.live import experiment
from tools.logs.hand_path import HandRow, hand_path
from tools.logs.run_log import read_run
from tools.number_arguments import finite
from tools.sim import recorded_lockstep
from tools.sim.centralised.fleet import CONTROLS, SHIPPED
from tools.terminal import Console
from tools.verb_table import Subparsers, add_verb


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "sim",
        """
        xrl sim
        xrl sim --delay 10 --out out/slow
        xrl sim --delay 5 --jitter 5 --loss 0.1 --seed 3
        xrl sim --scenario crawl --kill planner@8
        xrl sim --delay 50 --control centralised
        xrl sim --plant drivetrain.stiffness=3000 --plant drivetrain.play=0.01
        xrl sim --plant ideal
        xrl sim --controller examples/lqr_controller.py
        xrl sim --scenario stand --hand out/view/run.mcap     # as a person led it there
        xrl sim --inject 'planner->joints delay=30 jitter=10 at=3 for=4'
        xrl sim --inject 'all partition at=3 for=2' --inject 'planner->left loss=0.5 at=6'
        """,
    )
    experiment.add_flags(parser)
    parser.add_argument(
        "--delay", type=finite, default=1.0, metavar="MS", help="of every link, each way (1)"
    )
    parser.add_argument(
        "--jitter",
        type=finite,
        default=0.0,
        metavar="MS",
        help="half the width of a uniform spread (0)",
    )
    parser.add_argument(
        "--loss",
        type=finite,
        default=0.0,
        metavar="P",
        help="probability that a message is lost, 0 to 1 (0)",
    )
    parser.add_argument(
        "--control",
        choices=CONTROLS,
        default=SHIPPED,
        help="who computes the torques; centralised: the planner all of them, a baseline to "
        "compare with (default: distributed)",
    )
    parser.add_argument(
        "--hand",
        type=Path,
        metavar="RUN",
        help="lead and push as somebody did in this record (`operator/hand`), in place of the "
        "scenario's path",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where results go (default: out/sim-<time>)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the experiment; 0 only if the robot stood to the end."""
    require("sim")
    if args.delay < 0.0 or args.jitter < 0.0 or not 0.0 <= args.loss <= 1.0:
        raise RunError("--delay and --jitter must be at least 0 ms, --loss from 0 to 1")
    console = Console()
    robot, scenario = experiment.make_robot(args), experiment.make_scenario(args)
    true_plant = plant_from(args.plant)
    hand = _path_of(args.hand) if args.hand is not None else ()
    if args.controller is not None and args.control != SHIPPED:
        raise RunError("--controller and --control: one of them says who computes the torques")
    if args.controller is not None:
        controller_maker(args.controller, robot)  # refused before anything is written
    network = Impairment(delay_ms=args.delay, jitter_ms=args.jitter, loss=args.loss)
    out = experiment.make_out(args.out, "sim")
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
                robot, scenario, network, args.seed, out, watch, args.control, true_plant, hand,
                args.controller,
            )  # fmt: skip
        except KeyboardInterrupt:
            console.print(
                f"interrupted; what was recorded until then is in {out}, and `xrl log recover` "
                "finishes its file",
                soft_wrap=True,
            )
            raise
    factor = simulated_s / (time.monotonic() - begin)
    summary = recorded_lockstep.judge_in_lockstep(scenario, out, speed=factor)
    verdict_table.show(summary, console)
    console.print(f"{factor:.1f} x real time; {out}/run.mcap, run.png, summary.json", style="dim")
    return verdict.exit_code(summary)


def _path_of(record: Path) -> tuple[HandRow, ...]:
    """Return how the hand was led in a record.

    Raises:
        RunError: it cannot be read, or nobody led it there.
    """
    log = read_run(record)
    path = hand_path(log)
    if not path and log.messages(topics.OPERATOR_HAND):
        raise RunError(f"{record}: no scenario ran while somebody led; `xrl demo --view` runs one")
    if not path:
        raise RunError(f"{record}: nobody led the hand there; in `xrl demo --view` a person does")
    return path
