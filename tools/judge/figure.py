"""The picture of a run, like the paper's Fig. 7: COM and torso angles against time."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from shared.bus import topics
from shared.bus.messages import JointState, Mode, PlannerMode, RunEvent, RunEventKind
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config import files as config_file
from shared.exceptions import ConfigError, RunError
from shared.extras import late
from shared.joints import MODULES
from tools.judge.verdict import Summary, course, fell
from tools.logs.impairment_intervals import Impaired, impairments
from tools.logs.run_log import RunLog, text_of
from tools.output import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib import patches
else:
    patches = late("matplotlib.patches")

MODE_COLOURS: Final[dict[int, str]] = {
    Mode.DISARMED: "#d9d9d9",
    Mode.HOLD: "#f2a65a",
    Mode.TRACK: "#4c9f70",
    Mode.DAMP: "#8f5fbf",
    Mode.FAULT: "#c0392b",
}
LINES: Final = ("#1f4e79", "#c8553d", "#5b8c5a")
MODULE_LINES: Final = ("#1f4e79", "#4a90c4", "#7fc4d8", "#8c2d19", "#c8553d", "#e09f5b")
IMPAIRED_COLOUR: Final = "#8f7fc8"
STALLED_COLOUR: Final = "#6b6b6b"
IMPAIRED_TEXT: Final = "#3f2f6f"
LEADS_COLOUR: Final = MODE_COLOURS[Mode.TRACK]
WAITS_COLOUR: Final = "#b9c4cf"
EVENT_COLOURS: Final = {
    RunEventKind.KILLED: "#c0392b",
    RunEventKind.RESTARTED: "#2e7d32",
    RunEventKind.PUSHED: "#7f7f7f",
    RunEventKind.FAULTED: "#b8590b",
}
AGE_MOST_MS: Final = 50.0
"""If the log does not tell its robot's greatest usable age."""
AGE_REACH: Final = 1.2
"""Top of the panel of ages, ms: older commands are not used."""
SILENT_S: Final = 0.1
"""A service that says nothing for so long has a gap in the picture."""
LANES_MAX: Final = 8
"""Impairments with a lane each; the rest share the last, without words."""


def draw(log: RunLog, name: str, summary: Summary, path: Path) -> None:
    """Draw a run into a PNG file."""
    t, rows, began, zero_ns = course(log)
    end_s = float(t[-1])
    network = impairments(log.messages(topics.LINK_EVENT))
    heights = [2.0, 1.4, 1.7, 1.5, 1.6, 1.6]
    if network:
        heights.insert(4, 0.2 + 0.22 * min(len(network), LANES_MAX))
    figure = new_figure(11.5, 1.15 * sum(heights))
    axes = figure.subplots(
        len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights}, squeeze=False
    )[:, 0]
    com = np.array([row.over for row in rows]) * 1e3
    _lines(axes[0], t, com, ("x", "y"), "COM in mm")
    height = np.array([row.torso[2] for row in rows])
    _lines(axes[1], t, height[:, None], ("torso height",), "height in m")
    angles = np.array([row.angles for row in rows])
    _lines(axes[2], t, angles, ("roll", "pitch", "yaw"), "torso in rad")
    force = np.array([row.operator_force[:0:-1] for row in rows])  # z, y
    force = force if force[:, 1].any() else force[:, :1]
    _lines(axes[3], t, force, ("operator's\nhand, z", "hand, y"), "force in N")
    if any(row.load_n for row in rows):
        load = [row.load_n for row in rows]
        axes[3].plot(t, load, color=LINES[2], lw=1.1, label="weight on\nthe harness")
        _legend(axes[3])
    _ages(axes[-2], log, zero_ns)
    _modes(axes[-1], log, zero_ns, end_s)
    plots = [*axes[:4], *axes[-2:]]
    _events(plots, log.messages(topics.RUN_EVENT))
    _stalls(plots, summary.stalls)
    if network:
        _network(axes[4], network, zero_ns, end_s)
        _shade(plots, network, zero_ns, end_s)
    axes[-1].set_xlabel("scenario time in s" if began else "time since the hoist let go in s")
    axes[-1].set_xlim(0.0, end_s)
    verdict = "stood" if summary.stood else "FELL" if fell(summary) else "not finished"
    if summary.unsound:
        verdict = "stood, but not soundly"
    figure.suptitle(f"{name}: {verdict}", fontsize=12, x=0.01, ha="left")
    save_figure(figure, path)


def _lines(axis: Any, t: Any, columns: Any, names: Sequence[str], label: str) -> None:
    for column, name, colour in zip(columns.T, names, LINES, strict=False):
        axis.plot(t, column, color=colour, lw=1.1, label=name)
    _dress(axis, label)
    _legend(axis)


def _dress(axis: Any, label: str) -> None:
    axis.set_ylabel(label, fontsize=9)
    axis.grid(visible=True, lw=0.3, color="#bbbbbb")
    axis.tick_params(labelsize=8)


def _legend(axis: Any, handles: Sequence[Any] | None = None, **more: Any) -> None:
    """Put the legend beside the panel, where no curve is."""
    found = axis.get_legend_handles_labels()[0] if handles is None else handles
    usual = {
        "loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "fontsize": 8, "frameon": False,
        "borderaxespad": 0.2, "handlelength": 1.4,
    }  # fmt: skip
    axis.legend(handles=found, **(usual | more))


def _ages(axis: Any, log: RunLog, zero_ns: int) -> None:
    """Draw how old the newest command of each module was, and from where on it is not used."""
    most_ms = _greatest_age_ms(log)
    for module, colour in zip(MODULES, MODULE_LINES, strict=True):
        states: list[JointState] = log.messages(topics.JOINT_STATE, module)
        t = np.array([(state.t_ns - zero_ns) / NS_PER_S for state in states])
        age = np.array([state.age_ns / NS_PER_MS for state in states])
        age[age < 0.0] = np.nan
        age[np.diff(t, prepend=t[:1]) > SILENT_S] = np.nan
        style = "-" if module.endswith("right") else "--"
        axis.plot(t, age, color=colour, lw=0.7, ls=style, label=module)
    axis.axhline(most_ms, color="#c0392b", lw=1.0)
    axis.annotate(
        f"{most_ms:g} ms: HOLD", (1.005, most_ms), xycoords=("axes fraction", "data"),
        fontsize=8, color="#c0392b", va="center", annotation_clip=False,
    )  # fmt: skip
    axis.set_ylim(0.0, AGE_REACH * most_ms)
    _dress(axis, "command age\nin ms")
    _legend(axis, loc="lower left", bbox_to_anchor=(1.0, 0.0), borderaxespad=0.1, labelspacing=0.2)


def _greatest_age_ms(log: RunLog) -> float:
    """Return the age from which on a command is not used, by the robot file in the log, ms."""
    with contextlib.suppress(ConfigError, RunError):
        robot = config_file.parse(text_of(log, "robot.toml"), "robot.toml")
        return robot.joint_service.max_command_age_ms
    return AGE_MOST_MS


def _modes(axis: Any, log: RunLog, start_ns: int, end_s: float) -> None:
    """Draw the planner's state and each service's mode as bars; white where one said nothing."""
    statuses = log.messages(topics.PLANNER_STATUS)
    leads = [
        LEADS_COLOUR if row.mode == PlannerMode.LEADING else WAITS_COLOUR if row.wait_s > 0 else ""
        for row in statuses
    ]
    _bars(axis, 0, [(row.t_ns - start_ns) / NS_PER_S for row in statuses], leads)
    for place, module in enumerate(MODULES, 1):
        states: list[JointState] = log.messages(topics.JOINT_STATE, module)
        times = [(state.t_ns - start_ns) / NS_PER_S for state in states]
        _bars(axis, place, times, [MODE_COLOURS.get(state.mode, "black") for state in states])
    axis.set_yticks(range(len(MODULES) + 1), ["planner", *MODULES], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlim(0.0, end_s)
    axis.tick_params(labelsize=8)
    handles = [
        patches.Patch(color=colour, label=Mode(mode).name) for mode, colour in MODE_COLOURS.items()
    ]
    handles[2].set_label("TRACK; planner leads")
    if WAITS_COLOUR in leads:
        handles.append(patches.Patch(color=WAITS_COLOUR, label="planner waits\nafter drop-outs"))
    _legend(axis, handles)


def _bars(axis: Any, place: int, times: Sequence[float], colours: Sequence[str]) -> None:
    """Draw one row of coloured bars; no bar where the colour is empty or unknown."""
    begin, colour, last = 0.0, "", 0.0
    spans: dict[str, list[tuple[float, float]]] = {}
    for t, now in zip(times, colours, strict=True):
        if now != colour or t - last > SILENT_S:
            spans.setdefault(colour, []).append((begin, last - begin))
            begin, colour = t, now
        last = t
    spans.setdefault(colour, []).append((begin, last - begin))
    for name, bars in spans.items():
        if name:
            axis.broken_barh(bars, (place - 0.4, 0.8), color=name)


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


def _stalls(axes: Any, stalls: Sequence[dict[str, Any]]) -> None:
    """Shade stalls, and the time that is judged apart because of them."""
    for row in stalls:
        begin, end = row["at_s"], row["at_s"] + row["lasted_ms"] / 1e3
        for axis in axes:
            axis.axvspan(begin, end, color=STALLED_COLOUR, alpha=0.8, lw=0.0, zorder=0)
            if row["modules_held"]:
                axis.axvspan(begin, row["apart_until_s"], alpha=0.15,
                             color=STALLED_COLOUR, lw=0.0, zorder=0)  # fmt: skip
        if row["modules_held"]:
            axes[0].annotate(
                f"{row['who']} stood still, {row['lasted_ms']:.0f} ms", (begin, 1.0),
                xycoords=("data", "axes fraction"), xytext=(0, 13), textcoords="offset points",
                ha="left", fontsize=8, color=STALLED_COLOUR,
            )  # fmt: skip


def _shade(axes: Any, network: Sequence[Impaired], zero_ns: int, end_s: float) -> None:
    """Shade impairments of the network: darker where two overlap, a line at the start of each."""
    for row in network:
        begin, end = _extent(row, zero_ns, end_s)
        for axis in axes:
            axis.axvspan(begin, end, color=IMPAIRED_COLOUR, alpha=0.2, lw=0.0, zorder=0)
            for edge, style in ((begin, "-"), (end, ":")):
                axis.axvline(edge, color=IMPAIRED_COLOUR, lw=0.7, ls=style, zorder=0.5)


def _network(axis: Any, network: Sequence[Impaired], zero_ns: int, end_s: float) -> None:
    """Draw a lane for each impairment, with its words in a place where nothing else is."""
    for number, row in enumerate(network):
        lane = min(number, LANES_MAX - 1)
        begin, end = _extent(row, zero_ns, end_s)
        axis.broken_barh([(begin, end - begin)], (lane - 0.42, 0.84), color=IMPAIRED_COLOUR,
                         alpha=0.45, lw=0.0)  # fmt: skip
        words = f"{row.title}, {row.when(zero_ns)}"
        if len(network) > LANES_MAX and number >= LANES_MAX - 1:
            if number > LANES_MAX - 1:
                continue
            words = f"{len(network) - number} more"
        late = begin > end_s / 2.0
        axis.annotate(
            words, (end if late else begin, lane), xytext=(-3 if late else 3, 0),
            textcoords="offset points", ha="right" if late else "left", va="center_baseline",
            fontsize=8, color=IMPAIRED_TEXT, zorder=5,
        )  # fmt: skip
    axis.set_ylim(min(len(network), LANES_MAX) - 0.4, -0.6)
    axis.set_yticks([])
    axis.set_ylabel("network", fontsize=9)
    axis.grid(visible=True, axis="x", lw=0.3, color="#bbbbbb")
    axis.tick_params(labelsize=8)


def _extent(row: Impaired, zero_ns: int, end_s: float) -> tuple[float, float]:
    """Return where an impairment begins and ends within the picture, s."""
    end = row.end_s(zero_ns)
    begin = min(max(0.0, row.begin_s(zero_ns)), end_s)
    return begin, end_s if end is None else min(max(begin, end), end_s)


def _label(kind: RunEventKind, event: RunEvent) -> str:
    if kind is RunEventKind.PUSHED:
        return f"push {event.detail.partition(' for ')[0]}"
    if kind is RunEventKind.RESTARTED:
        return f"{event.subject} back"
    return f"{event.subject} {event.detail}"
