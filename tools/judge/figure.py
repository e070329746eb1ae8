"""Judges a run, and writes `summary.json` and the picture `run.png` beside its log.

The picture resembles the paper's Fig. 7: COM and torso angles against time.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from shared.atomic_file import replace_file
from shared.extras import late
from tools.judge import verdict
from tools.judge.reports.events import Events, TimelineEvent
from tools.judge.reports.panels import COLOURS, GAP_S, Line, Panel, panels_of
from tools.judge.reports.run_data import RunData
from tools.judge.verdict import ShownStall, Summary, fell
from tools.logs.run_index import RunIndex, files_of_run, head_of
from tools.logs.run_log import PICTURE_MAX_S, RunLog, RunPart
from tools.output import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib import patches
else:
    patches = late("matplotlib.patches")

PANELS: Final = {
    "COM": 2.0, "Height": 1.4, "Torso angles": 1.7, "Operator's force": 1.5, "Command age": 1.6,
    "Modes": 1.8,
}  # fmt: skip
"""Panels of the picture and their heights."""
INKS: Final = {
    "idle": "#d9d9d9", "warn": "#f2a65a", "good": "#4c9f70", "odd": "#8f5fbf", "bad": "#c0392b",
    "net": "#8f7fc8",
}  # fmt: skip
"""Colours by the names in `COLOURS`."""
LINES: Final = (
    "#1f4e79", "#c8553d", "#5b8c5a", "#8c2d19", "#4a90c4", "#e09f5b", "#7fc4d8", "#6b6b6b",
)  # fmt: skip
STALLED_COLOUR: Final = "#6b6b6b"
EVENT_COLOURS: Final = {
    "kill": "#c0392b", "fall": "#c0392b", "estop": "#c0392b", "restart": "#2e7d32",
    "fault": "#b8590b", "network": "#3f2f6f",
}  # fmt: skip
"""Colours by kind of event; the others are grey."""
LABEL_ROWS: Final = 3
"""Rows of event names above the first panel."""


def judge_run(out: Path, title: str, duration_s: float, **figures: float | None) -> Summary:
    """Judge a run of a scenario of `duration_s`, and write `summary.json` and `run.png` beside it.

    The picture of a long run shows its end. `figures` are fields of the summary that are not in
    the log.
    """
    path = out / "run.mcap"
    index = RunIndex(path, files_of_run(path, head_of(path)))  # a long record is split
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
    draw(log, title, summary, out / "run.png")
    return summary


def draw(log: RunLog, name: str, summary: Summary, path: Path) -> None:
    """Draw a run to a PNG file."""
    run = RunData(log)
    panels = panels_of(run)
    events = Events()
    events.add(run, panels)
    drawn = {panel.title: panel for panel in panels if panel.title in PANELS}
    figure = new_figure(11.5, 1.15 * sum(PANELS.values()))
    axes = figure.subplots(
        len(PANELS), 1, sharex=True, gridspec_kw={"height_ratios": [*PANELS.values()]}
    )
    for axis, title in zip(axes, PANELS, strict=True):
        panel = drawn[title]
        axis.set_ylabel(f"{title}\nin {panel.unit}" if panel.unit else title, fontsize=9)
        axis.grid(visible=True, lw=0.3, color="#bbbbbb")
        axis.tick_params(labelsize=8)
        if panel.rows:
            _bars(axis, panel)
        else:
            _lines(axis, panel)
    begin_s, end_s = 0.0 if run.course else run.span.begin, run.span.end
    for begin, end, _ in drawn["Modes"].rows.get("network", ()):
        for axis in axes[:-1]:
            axis.axvspan(begin, end, color=INKS["net"], alpha=0.2, lw=0.0, zorder=0)
    _events(axes, [row for row in events.all(run.span) if row.mark], end_s - begin_s)
    _stalls(axes, summary.stalls)
    axes[-1].set_xlabel(f"{run.axis.removesuffix(', s')} in s")
    axes[-1].set_xlim(begin_s, end_s)
    word = "stood" if summary.stood else "FELL" if fell(summary) else "not finished"
    if summary.unsound:
        word = "stood, but not soundly"
    figure.suptitle(f"{name}: {word}", fontsize=12, x=0.01, ha="left")
    save_figure(figure, path)


def _lines(axis: Any, panel: Panel) -> None:
    for line in panel.lines:
        if not line.hidden:
            style = "--" if line.dashed else "-"
            ink = LINES[line.colour % len(LINES)]
            axis.plot(*_with_gaps(line), color=ink, lw=1.0, ls=style, label=line.label)
    for value, label, shown in panel.levels:
        if shown:
            axis.axhline(value, color=INKS["bad"], lw=1.0)
            axis.annotate(
                f"{value:g} {panel.unit}: {label}", (1.005, value), va="center", fontsize=8,
                xycoords=("axes fraction", "data"), color=INKS["bad"], annotation_clip=False,
            )  # fmt: skip
    if panel.reach is not None:
        axis.set_ylim(0.0, panel.reach)
    low = {"loc": "lower left", "bbox_to_anchor": (1.0, 0.0)} if panel.reach is not None else {}
    _legend(axis, axis.get_legend_handles_labels()[0], **low)


def _with_gaps(line: Line) -> tuple[Any, Any]:
    """Return times and values; a line has a gap where its sender was silent."""
    is_late = np.diff(line.t, prepend=line.t[:1]) > GAP_S
    return line.t, np.where(is_late, np.nan, line.values)


def _legend(axis: Any, handles: Sequence[Any], **more: Any) -> None:
    """Put the legend beside the panel, clear of the curves."""
    usual = {
        "loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "fontsize": 8, "frameon": False,
        "borderaxespad": 0.2, "handlelength": 1.4, "labelspacing": 0.2,
    }  # fmt: skip
    axis.legend(handles=handles, **(usual | more))


def _bars(axis: Any, panel: Panel) -> None:
    """Draw a row of coloured bars for the planner, each module and the network."""
    names = {name: COLOURS.get(name, "idle") for row in panel.rows.values() for *_, name in row}
    for place, row in enumerate(panel.rows.values()):
        for name, colour in names.items():
            spans = [(begin, end - begin) for begin, end, bar in row if bar == name]
            axis.broken_barh(spans, (place - 0.4, 0.8), color=INKS[colour], lw=0.0)
    axis.set_yticks(range(len(panel.rows)), list(panel.rows), fontsize=8)
    axis.invert_yaxis()
    handles = [
        patches.Patch(
            color=INKS[colour], label="\n".join(one for one in names if names[one] == colour)
        )
        for colour in dict.fromkeys(names.values())
    ]
    _legend(axis, handles)


def _events(axes: Any, events: Sequence[TimelineEvent], length_s: float) -> None:
    """Mark events in every panel, with their names above the first panel."""
    ends = [-np.inf] * LABEL_ROWS
    for event in events:
        colour = EVENT_COLOURS.get(event.kind, "#7f7f7f")
        for axis in axes:
            axis.axvline(event.t, color=colour, lw=1.0, ls="--")
        half_s = 0.004 * len(event.mark) * length_s
        row = next((row for row, end in enumerate(ends) if event.t - half_s > end), None)
        if row is None:
            continue
        ends[row] = event.t + half_s
        axes[0].annotate(
            event.mark, (event.t, 1.0), xycoords=("data", "axes fraction"), ha="center",
            xytext=(0, 3 + 11 * row), textcoords="offset points", fontsize=8, color=colour,
        )  # fmt: skip


def _stalls(axes: Any, stalls: Sequence[ShownStall]) -> None:
    """Shade stalls, and the time that led and held figures exclude because of them."""
    for row in stalls:
        end = row.at_s + row.lasted_ms / 1e3
        apart = row.apart_until_s if row.modules_held else end
        for axis in axes:
            axis.axvspan(row.at_s, end, color=STALLED_COLOUR, alpha=0.8, lw=0.0, zorder=0)
            axis.axvspan(end, apart, color=STALLED_COLOUR, alpha=0.15, lw=0.0, zorder=0)
