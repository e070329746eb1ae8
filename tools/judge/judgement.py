"""Judges a recorded run by its log alone; writes the summary and the picture beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from shared.atomic_file import replace_file
from shared.exceptions import RunError
from shared.mcap_log.sequence_stats import KeyCount
from tools.judge import figure, verdict
from tools.judge.verdict import Summary
from tools.logs.run_index import RunIndex
from tools.logs.run_log import PICTURE_MAX_S, RunLog, RunPart, parts_of


def judge_run(
    out: Path, title: str, duration_s: float, figures: Mapping[str, Any] | None = None
) -> Summary:
    """Judge a run of a scenario of `duration_s`; write `summary.json` and `run.png` beside it.

    The picture of a long run is that of its end. `figures` are laid over those from the log.
    """
    index = RunIndex(out / "run.mcap")
    last_s = max(0.0, index.length_s - PICTURE_MAX_S)
    log = RunLog(index, RunPart(last_s))
    if last_s > 0.0:
        summary = summarise_parts(index, duration_s)
        title = f"{title}: the last {PICTURE_MAX_S:g} s"
    else:
        summary = verdict.summarise(log, duration_s)
    summary |= figures or {}
    replace_file(out / "summary.json", json.dumps(summary, indent=2).encode() + b"\n")
    figure.draw(log, title, summary, out / "run.png")
    return summary


def summarise_parts(index: RunIndex, duration_s: float) -> Summary:
    """Return the figures of a run that is read in parts; RunError says why none can be judged."""
    found: list[Summary] = []
    counts: dict[str, KeyCount] = {}
    why: RunError | None = None
    for part in parts_of(index):
        part.count_into(counts)
        try:
            found.append(verdict.summarise(part, duration_s))
        except RunError as error:  # the scenario has not begun in it
            why = why or error
    if not found:
        raise why or RunError(f"{index.path}: holds nothing to judge")
    return verdict.joined(found, counts.values())
