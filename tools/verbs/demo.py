"""`xrl demo`: the paper's experiment, live: start the fleet, kill the planner, judge."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from services.simulator.plant import plant_from
from shared.bus import topics
from shared.bus.messages import PlannerStatus
from shared.bus.session import Session
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from tools.fleet import procfs
from tools.fleet.pace import add_pace
from tools.fleet.supervise import SupervisedFleet
from tools.runs import experiment, verdict_table
from tools.runs.judgement import judge_run
from tools.runs.live import run_live
from tools.runs.live_view import LiveView
from tools.runs.scenario_runner import ScenarioRunner
from tools.verb_table import Subparsers, add_verb

EXIT_FELL = 1


def add_parser(subparsers: Subparsers) -> None:
    """Add the verb."""
    parser = add_verb(
        subparsers,
        "demo",
        """
        xrl demo
        xrl demo --out out/b --kill planner@6.2 --restart planner@9
        xrl demo --kill planner@3.1:STOP --restart planner@7
        xrl demo --scenario crawl --kill planner@8
        xrl demo --jacobian average
        xrl demo --plant drivetrain.stiffness=3000
        xrl demo --duration 8 --push 4:0.3:40,0,0
        xrl demo --pace 0.5
        """,
    )
    experiment.add_flags(parser)
    add_pace(parser)
    parser.add_argument(
        "--no-restart",
        action="store_true",
        help="services that end by themselves stay down; without it the supervisor restarts "
        "them. What --kill kills stays down until its --restart either way",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="where results go (default: out/demo-<time>)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the experiment; 0 only if the robot stood to the end."""
    console = Console()
    robot, scenario = experiment.make_robot(args), experiment.make_scenario(args)
    plant_from(args.plant)  # refused before anything is started
    out = experiment.make_out(args.out, "demo")
    experiment.introduce(scenario, console)
    for other in procfs.fleets():
        console.print(
            f"[yellow]another fleet runs in {other}: two do not fit on two cores; "
            f"`xrl down --run-dir {other}` stops it[/]"
        )
    try:
        cpu_pct = lead_run(args, robot, scenario, out, console)
    except KeyboardInterrupt:
        console.print(f"interrupted; what was recorded until then is in {out}")
        raise
    return judge(out, scenario, cpu_pct, console)


def lead_run(
    args: argparse.Namespace, robot: RobotConfig, scenario: Scenario, out: Path, console: Console
) -> float | None:
    """Run the scenario on a fleet of its own, and show it.

    Returns:
        CPU use of all processes together, %: 100 is one core; None if the scenario never started.
    """
    console.print(
        f"starting {len(robot.services)} services; modes below: right ankle, knee, hip, then left; "
        "D disarmed, H hold, T track, F fault, - silent",
        style="dim",
    )

    def lead(fleet: SupervisedFleet, session: Session) -> float | None:
        planner = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        with LiveView(console, scenario.inject, planner) as view:
            return ScenarioRunner(fleet, session, scenario, view.show).run()

    return run_live(
        out,
        robot,
        scenario,
        lead,
        verb="demo",
        seed=args.seed,
        true_plant=plant_from(args.plant),
        pace=args.pace,
        tell=lambda text: console.print(f"[yellow]{text}[/]", highlight=False, soft_wrap=True),
        no_restart=robot.services if args.no_restart else {kill.service for kill in scenario.kill},
    )


def judge(out: Path, scenario: Scenario, cpu_pct: float | None, console: Console) -> int:
    """Write summary and picture from the log, print the verdict, return the exit code."""
    summary = judge_run(out, scenario.name, scenario.duration, {"fleet_cpu_pct": cpu_pct})
    verdict_table.show(summary, console)
    console.print(f"{out}/run.mcap, run.png, summary.json, logs/", style="dim", highlight=False)
    return 0 if summary["stood"] else EXIT_FELL
