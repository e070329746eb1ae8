"""One case alone, recorded and judged like a run of `xrl sim`."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Protocol, TypeVar

import msgspec
from rich.console import Console

from services.recorder import provenance
from services.recorder.mcap_log import SCHEMA_VERSION, RunWriter
from services.simulator.plant import PlantConfig
from shared.bus import topics
from shared.bus.messages import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Scenario
from shared.robot.robot_model import mjcf
from tools.runs import experiment, figure, verdict
from tools.runs.lockstep import Record
from tools.runs.run_log import read_run
from tools.runs.verdict import Summary
from tools.sim import AFTER_FALL_S, DRAIN_EVERY, NOT_HERE, Outbox
from tools.sweeps import study
from tools.sweeps.figures import Ended, Watch

Outcome = TypeVar("Outcome", bound=Ended)
Outcome_co = TypeVar("Outcome_co", bound=Ended, covariant=True)

ROOT: Final = Path(__file__).resolve().parents[2]


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
    facts: dict[str, str],
    console: Console,
    true_plant: PlantConfig,
) -> int:
    """Run a case under a progress bar and print its figures.

    Args:
        run: runs it.
        scenario: what happens.
        robot: ready to run.
        out: folder for its log; None: no log.
        facts: for the log, as for `record_run`.
        console: to print on.
        true_plant: that `run` simulates.

    Returns:
        0 if the robot stood, else 1.

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
            outcome, _ = record_run(
                scenario,
                robot,
                out,
                facts,
                lambda record, look: run(record=record, watch=look, after_fall_s=AFTER_FALL_S),
                watch,
                true_plant,
            )
    study.show("Measured", msgspec.structs.asdict(outcome), console)
    if out is not None:
        console.print(f"{out}/run.mcap, run.png, summary.json", style="dim", soft_wrap=True)
    console.print(f"[bold]{outcome.ending}[/]")
    return 0 if outcome.stood else 1


def record_run(
    scenario: Scenario,
    robot: RobotConfig,
    out: Path,
    facts: dict[str, str],
    run: Callable[[Record, Watch], Outcome],
    watch: Watch,
    true_plant: PlantConfig,
) -> tuple[Outcome, Summary]:
    """Run a case into `run.mcap`, with `summary.json` and `run.png` beside it.

    Args:
        scenario: what happens.
        robot: ready to run.
        out: an empty folder.
        facts: for the log, beside robot and scenario: `lockstep` with the command, at least.
        run: runs the case; it is given who takes every message, and who sees the world.
        watch: sees the world at its rate.
        true_plant: that `run` simulates.

    Returns:
        What `run` returned, and the log's summary.

    Raises:
        RunError: the log cannot be written, or holds nothing to judge.
    """
    inputs = experiment.write_inputs(out, robot, scenario, true_plant)
    outbox = Outbox(robot.name)
    recorded = {key: topic for key, topic in topics.all_keys(robot.name).items() if topic.recorded}
    run_facts = {
        "schema_version": SCHEMA_VERSION,
        "robot": robot.name,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "scenario": scenario.name,
    }
    with RunWriter(
        out,
        recorded,
        offset_ns=0,
        metadata={
            "run": run_facts | facts | provenance.code(ROOT) | provenance.machine(),
            "packages": provenance.packages(),
        },
        attachments={file.name: file.read_bytes() for file in inputs}
        | {"model.xml": mjcf(robot).encode()},
        chunk_kib=robot.recorder.chunk_kib,
    ) as writer:

        def drain(truth: SimTruth) -> None:
            if len(outbox) >= DRAIN_EVERY:
                writer.take_from(outbox, len(outbox))
            watch(truth)

        outcome = run(outbox.put, drain)
        writer.take_from(outbox, len(outbox))
    log = read_run(out / "run.mcap")
    summary = verdict.summarise(log, scenario.duration)
    summary |= dict.fromkeys(NOT_HERE) | {"in_real_time": True}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    figure.draw(log, f"{scenario.name} in lockstep", summary, out / "run.png")
    return outcome, summary
