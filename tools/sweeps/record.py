"""One case alone, recorded and judged like a run of `xrl sim`."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from services.recorder import provenance
from services.recorder.mcap_log import SCHEMA_VERSION, RunWriter
from shared import topics
from shared.config import RobotConfig
from shared.messages import SimTruth
from shared.robot_model import mjcf
from tools.runs import experiment, figure, verdict
from tools.runs.run_log import read_run
from tools.runs.verdict import Summary
from tools.sim import AFTER_FALL_S, DRAIN_EVERY, NOT_HERE, Outbox
from tools.sweeps.cases import Case, story_of
from tools.sweeps.outcome import Outcome, run_case

ROOT: Final = Path(__file__).resolve().parents[2]


def record_case(
    case: Case, robot: RobotConfig, out: Path, command: str, watch: Callable[[SimTruth], None]
) -> tuple[Outcome, Summary]:
    """Run a case into `run.mcap`, with `summary.json` and `run.png` beside it.

    Args:
        case: what happens.
        robot: with the case's payload, ready to run.
        out: an empty folder.
        command: that runs this case, for the log.
        watch: sees the world at its rate.

    Raises:
        RunError: the log cannot be written, or holds nothing to judge.
    """
    story = story_of(robot, case)
    inputs = experiment.write_inputs(out, robot, story)
    outbox = Outbox(robot.name)
    recorded = {key: topic for key, topic in topics.all_keys(robot.name).items() if topic.recorded}
    run_facts = {
        "schema_version": SCHEMA_VERSION,
        "robot": robot.name,
        "started": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "scenario": story.name,
        "lockstep": f"{command}; delay {case.delay_ms:g} ms, "
        + ("hand on" if case.let_go_s is None else f"hand off at {case.let_go_s:g} s"),
    }
    with RunWriter(
        out,
        recorded,
        offset_ns=0,
        metadata={
            "run": run_facts | provenance.code(ROOT) | provenance.machine(),
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

        outcome = run_case(case, robot, record=outbox.put, watch=drain, after_fall_s=AFTER_FALL_S)
        writer.take_from(outbox, len(outbox))
    log = read_run(out / "run.mcap")
    summary = verdict.summarise(log, story.duration)
    summary |= dict.fromkeys(NOT_HERE) | {"in_real_time": True}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    figure.draw(log, f"{story.name} in lockstep", summary, out / "run.png")
    return outcome, summary
