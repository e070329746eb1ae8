"""A live run: a fleet in its own run directory, led by a tool and then stopped."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TypeVar

from services.planner.controller import ATTACHED, absolute, split_spec
from services.simulator.physics.plant import PlantConfig
from shared.atomic_file import replace_file
from shared.bus.session import Session, open_session
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.robot.robot_model import mjcf
from tools.fleet.pace import run_at_fitting_pace
from tools.fleet.process_table import FleetOptions
from tools.fleet.supervise import SupervisedFleet
from tools.live import experiment
from tools.live.experiment import PLANT_FILE, record_of_start

T = TypeVar("T")


def run_live(
    out: Path,
    robot: RobotConfig,
    scenario: Scenario,
    lead: Callable[[SupervisedFleet, Session], T],
    *,
    verb: str,
    seed: int,
    true_plant: PlantConfig,
    no_restart: Collection[str],
    pace: float | None = None,
    controller: str | None = None,
    tell: Callable[[str], None] = lambda _text: None,
) -> T:
    """Start a fleet, call `lead`, stop the fleet; return what `lead` returns.

    Even after a failure, no process and no run directory remains, and the logs are in `out`.

    Args:
        out: folder for the run's log, its inputs and the services' logs.
        robot: the robot.
        scenario: motion of the simulated operator and faults of the drives; `lead` does the kills.
        lead: leads the run; receives the fleet and a session on its bus.
        verb: verb on the command line; names the run directory and the session.
        seed: seed of sensor noise, network losses and delays.
        true_plant: the simulated robot's differences from `robot`.
        no_restart: services that the supervisor does not restart when they end.
        pace: clock rate of the fleet. None: the default, lowered step by step while the cores are
            full; the pace found becomes the default of this process.
        controller: the user's controller, `FILE.py[:NAME]`; None: the law.
        tell: receives a line of text each time the pace is lowered.
    """
    out = out.absolute()
    robot_path, overrides = _prepare(out, robot, scenario, seed, true_plant, controller)

    def once(pace: float) -> T:
        options = FleetOptions(
            overrides=overrides,
            no_restart=no_restart,
            injected="network_proxy" in overrides,
            pace=pace,
            leashed=True,
        )
        return _run_once(out, robot, robot_path, options, verb, lead)

    def again(text: str) -> None:
        for record in out.glob("run*.mcap"):
            record.unlink()  # it shows only a robot that waited
        tell(text)

    return once(pace) if pace is not None else run_at_fitting_pace(once, again)


def _prepare(
    out: Path,
    robot: RobotConfig,
    scenario: Scenario,
    seed: int,
    true_plant: PlantConfig,
    controller: str | None,
) -> tuple[Path, dict[str, list[str]]]:
    """Write the services' input files; return the robot file, and extra arguments per service."""
    robot_path, scenario_path, plant_path, *_ = experiment.write_inputs(
        out, robot, scenario, true_plant
    )
    model_path = out / "model.xml"
    replace_file(model_path, mjcf(robot).encode())
    attached = {"model.xml": model_path, PLANT_FILE: plant_path}
    if controller is not None:
        attached[ATTACHED] = split_spec(controller)[0]
    seeded = ["--seed", str(seed)]
    led_by = ["--scenario", str(scenario_path)]
    overrides = {
        "simulator": [*led_by, "--plant", str(plant_path), *seeded],
        "recorder": ["--out", str(out), *led_by, "--scenario-text", scenario.name],
    }
    for name, path in attached.items():
        overrides["recorder"] += ["--attach", f"{name}={path.absolute()}"]
    if controller is not None:
        overrides["planner"] = ["--controller", absolute(controller)]
    if scenario.inject:
        overrides["network_proxy"] = seeded
    return robot_path, overrides


def _run_once(
    out: Path,
    robot: RobotConfig,
    robot_path: Path,
    options: FleetOptions,
    verb: str,
    lead: Callable[[SupervisedFleet, Session], T],
) -> T:
    run_dir = Path(tempfile.mkdtemp(prefix=f"xrl-{verb}-", dir="/tmp"))
    try:
        with record_of_start(out):
            fleet = SupervisedFleet.start(robot_path, run_dir, options)
        try:
            with open_session(robot, verb, run_dir) as session:
                return lead(fleet, session)
        finally:
            fleet.stop(keep_logs=True)
            logs = out / "logs"
            shutil.rmtree(logs, ignore_errors=True)
            shutil.copytree(fleet.run.logs, logs, dirs_exist_ok=True)
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)
