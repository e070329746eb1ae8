"""One case alone, recorded and judged like a run of `xrl sim`."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, TypeAlias, TypeVar

from services.recorder import provenance
from services.recorder.mcap_log import SCHEMA_VERSION, RunWriter
from shared import topics
from shared.config import RobotConfig
from shared.messages import SimTruth
from shared.robot_model import mjcf
from shared.scenario import Scenario
from tools.runs import experiment, figure, verdict
from tools.runs.lockstep import Record
from tools.runs.run_log import read_run
from tools.runs.verdict import Summary
from tools.sim import DRAIN_EVERY, NOT_HERE, Outbox

Outcome = TypeVar("Outcome")
Watch: TypeAlias = Callable[[SimTruth], None]

ROOT: Final = Path(__file__).resolve().parents[2]


def record_run(
    story: Scenario,
    robot: RobotConfig,
    out: Path,
    facts: dict[str, str],
    run: Callable[[Record, Watch], Outcome],
    watch: Watch,
) -> tuple[Outcome, Summary]:
    """Run a case into `run.mcap`, with `summary.json` and `run.png` beside it.

    Args:
        story: what happens.
        robot: ready to run.
        out: an empty folder.
        facts: for the log, beside robot and scenario: `lockstep` with the command, at least.
        run: runs the case; it is given who takes every message, and who sees the world.
        watch: sees the world at its rate.

    Returns:
        What `run` returned, and the log's summary.

    Raises:
        RunError: the log cannot be written, or holds nothing to judge.
    """
    inputs = experiment.write_inputs(out, robot, story)
    outbox = Outbox(robot.name)
    recorded = {key: topic for key, topic in topics.all_keys(robot.name).items() if topic.recorded}
    run_facts = {
        "schema_version": SCHEMA_VERSION,
        "robot": robot.name,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "scenario": story.name,
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
    summary = verdict.summarise(log, story.duration)
    summary |= dict.fromkeys(NOT_HERE) | {"in_real_time": True}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    figure.draw(log, f"{story.name} in lockstep", summary, out / "run.png")
    return outcome, summary
