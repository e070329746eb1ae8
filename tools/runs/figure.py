"""The picture of a run, like the paper's Fig. 7: COM and torso angles against time."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from shared import topics
from shared.clock import NS_PER_S
from shared.joints import MODULES
from shared.messages import JointState, Mode, RunEvent, RunEventKind
from shared.traces import LinkEvent
from tools.runs.run_log import RunLog
from tools.runs.verdict import Summary, course

mpl.use("Agg")

MODE_COLOURS: Final = {
    Mode.DISARMED: "#d9d9d9",
    Mode.HOLD: "#f2a65a",
    Mode.TRACK: "#4c9f70",
    Mode.DAMP: "#8f5fbf",
    Mode.FAULT: "#c0392b",
}
LINES: Final = ("#1f4e79", "#c8553d", "#5b8c5a")
IMPAIRED_COLOUR: Final = "#e6e0f3"
EVENT_COLOURS: Final = {
    RunEventKind.KILLED: "#c0392b",
    RunEventKind.RESTARTED: "#2e7d32",
    RunEventKind.PUSHED: "#7f7f7f",
    RunEventKind.FAULTED: "#b8590b",
}


def draw(log: RunLog, name: str, summary: Summary, path: Path) -> None:
    """Draw a run into a PNG file."""
    t, rows, began, zero_ns = course(log)
    figure = Figure(figsize=(11, 9.5), dpi=110, layout="constrained")
    axes = figure.subplots(
        5, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1.6, 1.8, 1.6, 1.4]}
    )
    com = np.array([row.com for row in rows]) * 1e3
    _lines(axes[0], t, com[:, :2], ("x", "y"), "COM in mm")
    height = np.array([row.torso[2] for row in rows])
    _lines(axes[1], t, height[:, None], ("torso height",), "height in m")
    angles = np.array([row.angles for row in rows])
    _lines(axes[2], t, angles, ("roll", "pitch", "yaw"), "torso in rad")
    force = np.array([row.operator_force[2] for row in rows])
    _lines(axes[3], t, force[:, None], ("operator's hand, z",), "force in N")
    if any(row.load_n for row in rows):
        load = [row.load_n for row in rows]
        axes[3].plot(t, load, color=LINES[1], lw=1.1, label="weight on the harness")
        axes[3].legend(loc="upper right", fontsize=8, ncols=2, framealpha=0.8)
    _modes(axes[4], log, zero_ns, float(t[-1]))
    _events(axes, log.messages(topics.RUN_EVENT))
    _impairments(axes, log.messages(topics.LINK_EVENT), zero_ns, float(t[-1]))
    axes[4].set_xlabel("scenario time in s" if began else "time since the hoist let go in s")
    axes[4].set_xlim(0.0, float(t[-1]))
    verdict = "stood" if summary["stood"] else "FELL" if summary["fallen_at_s"] else "not finished"
    figure.suptitle(f"{name}: {verdict}", fontsize=12, x=0.01, ha="left")
    figure.savefig(path)


def _lines(axis: Any, t: Any, columns: Any, names: tuple[str, ...], label: str) -> None:
    for column, name, colour in zip(columns.T, names, LINES, strict=False):
        axis.plot(t, column, color=colour, lw=1.1, label=name)
    axis.set_ylabel(label, fontsize=9)
    axis.grid(visible=True, lw=0.3, color="#bbbbbb")
    axis.legend(loc="upper right", fontsize=8, ncols=len(names), framealpha=0.8)
    axis.tick_params(labelsize=8)


def _modes(axis: Any, log: RunLog, start_ns: int, end_s: float) -> None:
    """Draw each service's mode as a coloured bar; white where it said nothing."""
    for row, module in enumerate(MODULES):
        states: list[JointState] = log.messages(topics.JOINT_STATE, module)
        begin, mode, last = None, None, 0.0
        spans: dict[int, list[tuple[float, float]]] = {}
        for state in states:
            t = (state.t_ns - start_ns) / NS_PER_S
            if begin is None or state.mode != mode or t - last > 0.1:
                if begin is not None and mode is not None:
                    spans.setdefault(mode, []).append((begin, last - begin))
                begin, mode = t, state.mode
            last = t
        if begin is not None and mode is not None:
            spans.setdefault(mode, []).append((begin, last - begin))
        for value, bars in spans.items():
            axis.broken_barh(bars, (row - 0.4, 0.8), color=MODE_COLOURS[Mode(value)])
    axis.set_yticks(range(len(MODULES)), MODULES, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlim(0.0, end_s)
    handles = [Patch(color=colour, label=mode.name) for mode, colour in MODE_COLOURS.items()]
    axis.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=5, fontsize=8,
        frameon=False,
    )  # fmt: skip


def _events(axes: Any, events: list[RunEvent]) -> None:
    """Mark kills, faults, restarts and pushes in every panel, with their names above the first."""
    for event in events:
        kind = RunEventKind(event.kind)
        colour = EVENT_COLOURS.get(kind)
        if colour is None:
            continue
        for axis in axes:
            axis.axvline(event.scenario_s, color=colour, lw=1.0, ls="--")
        axes[0].annotate(
            _label(kind, event),
            (event.scenario_s, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color=colour,
        )


def _impairments(axes: Any, events: list[LinkEvent], start_ns: int, end_s: float) -> None:
    """Shade what was done to the network, and say it once for all directions together."""
    begins: dict[int, LinkEvent] = {}
    ends: dict[int, LinkEvent] = {}
    for event in events:
        (begins if event.in_force else ends).setdefault(event.number, event)
    for number, event in begins.items():
        begin_s = max(0.0, (event.t_ns - start_ns) / NS_PER_S)
        over = ends.get(number)
        until_s = end_s if over is None else (over.t_ns - start_ns) / NS_PER_S
        for axis in axes:
            axis.axvspan(begin_s, until_s, color=IMPAIRED_COLOUR, lw=0.0, zorder=0)
        words = "\n".join([event.asked, *event.detail.split()])
        axes[1].annotate(
            words,
            (begin_s, 0.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, 3),
            textcoords="offset points",
            fontsize=7,
            color="#5d4b8a",
        )


def _label(kind: RunEventKind, event: RunEvent) -> str:
    if kind is RunEventKind.PUSHED:
        return f"push {event.detail.partition(' for ')[0]}"
    if kind is RunEventKind.RESTARTED:
        return f"{event.subject} back"
    return f"{event.subject} {event.detail}"
