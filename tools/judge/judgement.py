"""Judges a recorded run by its log alone; writes the summary and the picture beside it."""

from __future__ import annotations

from pathlib import Path

import msgspec

from shared.atomic_file import replace_file
from tools.judge import figure, verdict
from tools.judge.verdict import Summary
from tools.logs.run_index import RunIndex
from tools.logs.run_log import PICTURE_MAX_S, RunLog, RunPart


def judge_run(out: Path, title: str, duration_s: float, **figures: float | None) -> Summary:
    """Judge a run of a scenario of `duration_s`; write `summary.json` and `run.png` beside it.

    The picture of a long run is that of its end. `figures` are fields of the summary that no log
    tells.
    """
    index = RunIndex(out / "run.mcap")
    last_s = max(0.0, index.length_s - PICTURE_MAX_S)
    log = RunLog(index, RunPart(last_s))
    if last_s > 0.0:
        summary = verdict.summarise_parts(index, duration_s)
        title = f"{title}: the last {PICTURE_MAX_S:g} s"
    else:
        summary = verdict.summarise(log, duration_s)
    summary = msgspec.structs.replace(summary, **figures)
    text = msgspec.json.format(msgspec.json.encode(summary), indent=2)
    replace_file(out / "summary.json", text + b"\n")
    figure.draw(log, title, summary, out / "run.png")
    return summary
