"""Report page: one self-contained HTML file, which makes no network request."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np

from shared.arrays import Array
from shared.clock import NS_PER_S
from shared.exceptions import RunError
from shared.mcap_log.sequence_stats import KeyCount
from tools.judge.reports.events import Events, TimelineEvent
from tools.judge.reports.panels import COLOURS, GAP_S, Bar, Line, Panel, panels_of
from tools.judge.reports.run_data import RunData, Span
from tools.judge.reports.summary import Judge, inputs, verdict_and_facts
from tools.judge.run_parts import zero_ns
from tools.logs.run_index import RunIndex
from tools.logs.run_log import PART_S, SEE_INFO, WHOLE, RunLog, RunPart, parts_of

HERE: Final = Path(__file__).parent
VENDOR: Final = HERE / "vendor" / "uplot"
STYLES: Final = (VENDOR / "uPlot.min.css", HERE / "page.css")
LIBRARY: Final = VENDOR / "uPlot.iife.min.js"
SCRIPT: Final = HERE / "page.js"
POINTS: Final = 4000
"""Maximum number of points of a line: the minimum and maximum of each interval, so that a plot
shows every extreme and the page of an hour takes 2 MB."""
BEFORE_S: Final = {"fall": 3.0}
"""Time before an event that a click on it shows, s; 0.5 for the other kinds."""
HELP: Final = (
    "Drag in a plot to zoom all plots; double-click to show the whole run. The legends show the "
    "values at the cursor; click a name to hide or show its line. Dotted red lines are limits."
)
POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)
"""Makes the browser refuse every request to another server."""


class _PanelData:
    """A panel over all parts of a run."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self._lines: dict[str, tuple[Line, list[tuple[Array, Array]]]] = {}
        self._rows: dict[str, list[Bar]] = {}

    def add(self, panel: Panel, run: RunData) -> None:
        """Add this panel's data from a part of the run."""
        self._panel = panel
        for line in panel.lines:
            inside = run.inside(line.t) & (line.t >= run.span.begin) & (line.t <= run.span.end)
            parts = self._lines.setdefault(line.label, (line, []))[1]
            parts.append(thinned(line.t[inside], line.values[inside], run.span))
        for label, bars in panel.rows.items():
            row = self._rows.setdefault(label, [])
            for bar in bars:
                last = row[-1] if row else (-np.inf, -np.inf, "")
                if bar[2] == last[2] and bar[0] <= last[1] + GAP_S:
                    row[-1] = last[0], max(bar[1], last[1]), last[2]
                elif bar[1] > max(last[1], run.span.begin) and bar[0] < run.span.end:
                    row.append((max(bar[0], run.span.begin), *bar[1:]))

    def as_data(self) -> dict[str, Any] | None:
        """Return the panel as the page stores it, or None if it has no data."""
        panel, lines = self._panel, []
        for line, parts in self._lines.values():
            t, values = with_gaps(*map(np.concatenate, zip(*parts, strict=True)))
            if len(t):
                lines.append({
                    "label": line.label, "colour": line.colour, "hidden": line.hidden,
                    "dashed": line.dashed, "t": [round(at, 4) for at in t.tolist()],
                    "v": [None if value != value else float(f"{value:.5g}") for value in values],
                })  # fmt: skip
        rows = [
            [label, [(round(a, 4), round(b, 4), name) for a, b, name in bars]]
            for label, bars in self._rows.items()
        ]
        if not lines and not rows:
            return None
        return {
            "title": panel.title, "unit": panel.unit, "note": panel.note, "lines": lines,
            "levels": panel.levels, "reach": panel.reach, "rows": rows,
        }  # fmt: skip


def thinned(t: Array, values: Array, span: Span) -> tuple[Array, Array]:
    """Return a line's finite samples; of a long line, only the extremes of each short interval."""
    finite = np.isfinite(values)
    t, values = t[finite], values[finite]
    width_s = 2.0 * (span.end - span.begin) / POINTS
    if not len(t) or width_s <= 0.0:
        return t, values
    bins = ((t - span.begin) / width_s).astype(np.int64)
    firsts = np.flatnonzero(np.diff(bins, prepend=-1))
    by_value = np.lexsort((values, bins))
    kept = np.unique(np.concatenate((by_value[firsts], by_value[[*(firsts[1:] - 1), -1]])))
    return t[kept], values[kept]


def with_gaps(t: Array, values: Array) -> tuple[Array, Array]:
    """Return a line with NaN in each gap between its samples."""
    steps = np.diff(t)
    usual = float(np.median(steps)) if len(steps) else 0.0
    gaps = np.flatnonzero(steps > max(GAP_S, 5.0 * usual)) + 1
    return np.insert(t, gaps, t[gaps - 1] + 1e-3), np.insert(values, gaps, np.nan)


class Page:
    """The page of a run; `add` receives the run in parts, in order."""

    def __init__(self, zero_ns: int | None = None, span: Span | None = None) -> None:
        self._zero_ns, self._span = zero_ns, span
        self._about: RunData | None = None
        self._has_first = self._has_last = False
        self._panels: dict[str, _PanelData] = {}
        self._events = Events()
        self._judge = Judge()
        self._counts: dict[str, KeyCount] = {}

    def add(self, log: RunLog) -> None:
        """Add a run, or the next part of it."""
        run = RunData(log, self._zero_ns, self._span)
        self._has_first |= log.is_first
        self._has_last |= log.is_last
        if self._about is None or (self._about.course is None and run.course is not None):
            self._about = run  # a part in which the scenario runs names the time axis
        panels = panels_of(run)
        for panel in panels:
            self._panels.setdefault(panel.title, _PanelData(panel)).add(panel, run)
        self._events.add(run, panels)
        log.count_into(self._counts)
        self._judge.add(run, self._counts)

    def html(self) -> str:
        """Return the page."""
        run = self._about
        assert run is not None  # noqa: S101 - a run has a part
        name = run.log.metadata["run"].get("scenario") or run.log.path.name
        verdict = self._judge.verdict(whole=self._has_first and self._has_last)
        events = self._events.all(run.span)
        found = {title: panel.as_data() for title, panel in self._panels.items()}
        data = {
            "span": run.span,
            "marks": [[row.t, row.kind, row.mark] for row in events if row.mark],
            "colours": COLOURS,
            "panels": [data for data in found.values() if data is not None],
        }
        empty = ", ".join(title for title, data in found.items() if data is None)
        parts = (
            verdict_and_facts(run, verdict, name, self._counts),
            _tools(run),
            f'<div class="work">{_listed(events)}<main id="panels"></main></div>',
            f'<p class="hint" id="left-out">The log has no data for: {empty}.</p>' if empty else "",
            inputs(run),
        )
        text = json.dumps(data, separators=(",", ":"), allow_nan=False)
        prefix = "" if verdict.good is None else f"{verdict.sentence}: "
        return _document(f"{prefix}{name}, {run.log.robot}", "\n".join(parts), text)


def render(log: RunLog) -> str:
    """Return the page of a run that is loaded in memory."""
    page = Page()
    page.add(log)
    return page.html()


def render_parts(
    index: RunIndex,
    part: RunPart = WHOLE,
    *,
    part_s: float = PART_S,
    done: Callable[[float], None] = lambda _: None,
) -> str:
    """Return the page of a run or of a part of it, loading only `part_s` at a time."""
    zero = zero_ns(index)
    offset_s = (index.span_ns[0] - zero) / NS_PER_S
    begin_s, end_s = max(part.begin_s, 0.0), min(part.end_s, index.length_s)
    page = Page(zero, Span(begin_s + offset_s, end_s + offset_s))
    heard = False
    for log in parts_of(index, part, part_s=part_s, done=done):
        heard = heard or bool(log.keys())
        page.add(log)
    if not heard:
        raise RunError(f"{index.path}: no message in this part; {SEE_INFO}")
    return page.html()


def _document(title: str, body: str, data: str) -> str:
    style = "\n".join(path.read_text(encoding="utf-8") for path in STYLES)
    safe = data.replace("<", "\\u003c")  # so that the data contain no end tag
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
<style>
{style}</style>
</head>
<body>
{body}
<script type="application/json" id="data">{safe}</script>
<script id="uplot">{LIBRARY.read_text(encoding="utf-8")}</script>
<script>
{SCRIPT.read_text(encoding="utf-8")}</script>
</body>
</html>
"""


def _tools(run: RunData) -> str:
    buttons = "".join(
        f'<button type="button" data-do="{do}" title="{title}" aria-label="{title}">{text}</button>'
        for do, text, title in (
            ("left", "&larr;", "earlier"), ("right", "&rarr;", "later"),
            ("in", "+", "zoom in"), ("out", "&minus;", "zoom out"), ("all", "all", "whole run"),
        )
    )  # fmt: skip
    return (
        f'<nav class="tools" aria-label="time shown">{buttons}<output id="cursor"></output></nav>'
        f'<p class="hint">{escape(run.axis[0].upper() + run.axis[1:])}. {HELP}</p>'
        "<noscript><p>The plots need JavaScript; verdict, events and tables do not.</p></noscript>"
    )


def _listed(events: Sequence[TimelineEvent]) -> str:
    rows = "".join(
        f'<li class="{row.kind}"><button type="button" data-t="{row.t:.4f}" '
        f'data-before="{BEFORE_S.get(row.kind, 0.5):g}"><time>{row.t:.3f} s</time> '
        f"<span>{escape(row.text)}</span></button></li>"
        for row in events
    )
    return (
        '<section id="timeline"><h2>Events</h2><p class="hint">Click an event to show its time in '
        f'the plots.</p><ol aria-label="events">{rows or "<li>no events</li>"}</ol></section>'
    )
