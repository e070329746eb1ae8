"""`xrl demo`: runs the paper's experiment live: starts the fleet, kills the planner, judges."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Annotated, Final

from services.planner.controller import controller_maker
from services.simulator.physics.plant import plant_from
from shared.bus import topics
from shared.bus.messages import PlannerStatus
from shared.bus.session import Session
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.extras import require
from tools.flags import Arg, Folder
from tools.fleet.pace import PaceFlags
from tools.fleet.status_table import warn_of_others
from tools.fleet.supervise import SupervisedFleet
from tools.judge import verdict, verdict_table
from tools.judge.figure import judge_run
from tools.live import experiment
from tools.live.live import run_live
from tools.live.live_view import LiveView
from tools.live.scenario_runner import EndOfRun, ScenarioRunner
from tools.terminal import Console, marked
from tools.view.serving import PortFlags, served_beside

VIEW_S = 3600.0
"""Length of a run with --view but without --duration, s of scenario time, unless Ctrl-C ends it."""


EXAMPLES: Final = """
xrl demo
xrl demo --out out/b --kill planner@6.2 --restart planner@9
xrl demo --kill planner@3.1:STOP --restart planner@7
xrl demo --view                        # in a browser
xrl demo --scenario crawl --kill planner@8
xrl demo --controller examples/lqr_controller.py
xrl demo --duration 8 --push 4:0.3:40,0,0
"""


class DemoFlags(experiment.ExperimentFlags, PaceFlags, PortFlags):
    """Experiment to run, and options of its fleet."""

    scenario: Annotated[str, Arg(metavar="NAME|FILE")] = ""
    """file, or name of a scenario, shipped or in scenarios/ beside the robot file (default: squat,
    the paper's Fig. 7)"""
    no_restart: bool = False
    """do not restart services that end on their own; those that --kill or the scenario kills always
    wait for a requested restart"""
    view: bool = False
    """show the robot in a browser, and act on it there, by default in the scenario stand; without
    --duration the run ends at Ctrl-C or after an hour, then the verdict follows"""
    out: Folder | None = None
    """folder for the results (default: a new one in out/)"""


def run(flags: DemoFlags) -> int:
    """Run the experiment; return 0 only if the robot stood to the end."""
    require("sim")
    if flags.view:
        require("view", "leave out --view")
    console = Console()
    flags = dataclasses.replace(
        flags,
        scenario=flags.scenario or ("stand" if flags.view else "squat"),
        duration=VIEW_S if flags.view and flags.duration is None else flags.duration,
    )
    robot, scenario = experiment.make_robot(flags), experiment.make_scenario(flags)
    plant_from(flags.plant)  # reject invalid values before anything is started
    out = experiment.make_out(flags.out, "demo")
    experiment.introduce(scenario, console)
    warn_of_others(console)
    try:
        ended = _lead_run(flags, robot, scenario, out, console)
    except KeyboardInterrupt:
        console.print(f"interrupted; the record up to this point is in {out}")
        raise
    return judge(out, scenario, ended, console)


def _lead_run(
    flags: DemoFlags, robot: RobotConfig, scenario: Scenario, out: Path, console: Console
) -> EndOfRun:
    """Run the scenario on its own fleet and show it."""
    console.print(
        f"starting {len(robot.services)} services; modes below: right ankle, knee, hip, then left; "
        "D disarmed or damp, H hold, T track, F fault, - silent",
        style="dim",
    )

    def tell_of_machine(text: str) -> None:
        console.print(text, style="dim", highlight=False, soft_wrap=True)

    def lead(fleet: SupervisedFleet, session: Session) -> EndOfRun:
        planner = session.latest(topics.PLANNER_STATUS, PlannerStatus)
        with contextlib.ExitStack() as stack:
            ended = threading.Event()
            if flags.view:
                address = stack.enter_context(served_beside(fleet.run.path, flags.port))
                console.print(f"{address}  (Ctrl-C ends the run)", soft_wrap=True)
                stack.enter_context(_interrupts_set(ended))
            view = stack.enter_context(LiveView(console, scenario.inject, planner))
            runner = ScenarioRunner(fleet, session, scenario, view.show, tell=tell_of_machine)
            return runner.run(ended.is_set)

    if flags.controller is not None:
        controller_maker(flags.controller, robot)  # reject it before anything is started
    return run_live(
        out,
        robot,
        scenario,
        lead,
        verb="demo",
        seed=flags.seed,
        true_plant=plant_from(flags.plant),
        pace=flags.pace,
        controller=flags.controller,
        tell=lambda text: console.print(
            marked("[yellow]{}[/]", text), highlight=False, soft_wrap=True
        ),
        no_restart=robot.services if flags.no_restart else {kill.service for kill in scenario.kill},
    )


@contextlib.contextmanager
def _interrupts_set(event: threading.Event) -> Iterator[None]:
    """Set an event on Ctrl-C, which ends and judges the run; a second Ctrl-C interrupts."""

    def interrupted(number: int, frame: FrameType | None) -> None:
        if event.is_set():
            signal.default_int_handler(number, frame)
        event.set()

    before = signal.signal(signal.SIGINT, interrupted)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def judge(out: Path, scenario: Scenario, ended: EndOfRun, console: Console) -> int:
    """Write summary and picture from the log, print the verdict, return the exit code."""
    summary = judge_run(out, scenario.name, ended.scenario_s, fleet_cpu_pct=ended.cpu_pct)
    verdict_table.show(summary, console)
    console.print(f"{out}/run.mcap, run.png, summary.json, logs/", style="dim", highlight=False)
    return verdict.exit_code(summary)
