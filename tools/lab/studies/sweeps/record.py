"""One case alone, recorded and judged like a run of `xrl sim`."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, TypeVar

import msgspec

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from tools.lab.studies.sweeps import study
from tools.lab.studies.sweeps.figures import Ended, exit_code
from tools.live import experiment
from tools.sim.lockstep import Watch
from tools.sim.recorded_lockstep import AFTER_FALL_S, judge_in_lockstep, record_run
from tools.sim.virtual_time import Record
from tools.terminal import Console, marked

Outcome_co = TypeVar("Outcome_co", bound=Ended, covariant=True)


class Run(Protocol[Outcome_co]):
    """Runs a case."""

    def __call__(
        self,
        *,
        record: Record | None = None,
        watch: Watch | None = None,
        after_fall_s: float = 0.0,
    ) -> Outcome_co:
        """Run it; `record` takes every message, `watch` sees the world at its rate."""


def run_alone(
    run: Run[Ended],
    scenario: Scenario,
    robot: RobotConfig,
    out: Path | None,
    metadata: dict[str, str],
    console: Console,
    true_plant: PlantConfig,
) -> int:
    """Run a case under a progress bar and print its figures.

    Args:
        run: runs it.
        scenario: what happens.
        robot: ready to run.
        out: folder for its log; None: no log.
        metadata: for the log, as for `record_run`.
        console: to print on.
        true_plant: that `run` simulates.

    Returns:
        The exit code.

    Raises:
        RunError: the log cannot be written.
    """
    with study.bar("{task.completed:.1f} of {task.total:.1f} s", console) as bar:
        shown = bar.add_task("", total=scenario.duration)

        def watch(truth: SimTruth) -> None:
            bar.update(shown, completed=max(0.0, truth.scenario_s))

        if out is None:
            outcome = run(watch=watch)
        else:
            experiment.make_out(out, "sweep")
            outcome = record_run(
                scenario,
                robot,
                out,
                metadata,
                lambda record, look: run(record=record, watch=look, after_fall_s=AFTER_FALL_S),
                watch,
                true_plant,
            )
            judge_in_lockstep(scenario, out)
    study.show("Measured", msgspec.structs.asdict(outcome), console)
    if out is not None:
        console.print(f"{out}/run.mcap, run.png, summary.json", style="dim", soft_wrap=True)
    console.print(marked("[bold]{}[/]", outcome.ending))
    return exit_code([outcome.ending])
