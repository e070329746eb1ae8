"""The strip along time: where a kill would have been stood, and by how much."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shared.bus import topics
from shared.clock import NS_PER_S
from tools.lab.studies.counterfactual.run import Counterfactual
from tools.logs.run_log import RunLog
from tools.output import new_figure, save_figure

STOOD, FELL = "#2e7d32", "#c0392b"


def draw(
    log: RunLog, counterfactuals: Sequence[Counterfactual], title: str, every_s: float, path: Path
) -> None:
    """Draw the fates over the recorded height into a PNG file."""
    truth = [row for row in log.messages(topics.SIM_TRUTH) if row.scenario_s >= 0.0]
    figure = new_figure(11, 7.0)
    height, ended, com, margin = figure.subplots(
        4, 1, sharex=True, gridspec_kw={"height_ratios": [1.6, 0.4, 1.6, 1.2]}
    )
    height.plot([row.scenario_s for row in truth], [row.torso[2] for row in truth], lw=1.1)
    height.set_ylabel("torso height as recorded, m", fontsize=8)
    for one in counterfactuals:
        colour = STOOD if one.stood else FELL
        ended.axvspan(one.at_s, one.at_s + every_s, color=colour, lw=0)
    ended.set_yticks([])
    ended.set_ylabel("killed then", fontsize=8, rotation=0, ha="right", va="center")
    at = np.array([one.at_s for one in counterfactuals])
    com.plot(at, [one.com_x_max_mm for one in counterfactuals], ".-", ms=4, lw=0.8, label="x")
    com.plot(at, [one.com_y_max_mm for one in counterfactuals], ".-", ms=4, lw=0.8, label="y")
    com.set_ylabel("then COM at most, mm", fontsize=8)
    com.legend(loc="upper right", fontsize=8, ncols=2)
    known = [(one.at_s, one.margin) for one in counterfactuals if one.margin is not None]
    if known:
        margin.plot(*zip(*known, strict=True), ".-", ms=4, lw=0.8)
    margin.axhline(0.0, color=FELL, lw=0.8, ls="--")
    margin.set_ylabel("certificate's margin", fontsize=8)
    margin.set_xlabel("scenario time of the kill, s")
    for axis in (height, com, margin):
        axis.grid(visible=True, lw=0.3, color="#bbbbbb")
        axis.tick_params(labelsize=8)
    for event in log.messages(topics.RUN_EVENT):
        if event.scenario_s > 0.0 and event.t_ns < truth[-1].t_ns + NS_PER_S:
            height.axvline(event.scenario_s, color="#7f7f7f", lw=0.6, ls=":")
    figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    save_figure(figure, path)
