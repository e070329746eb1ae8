"""Report page: one HTML file that contains all it needs and makes no network request."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Final

from shared.clock import NS_PER_S
from shared.exceptions import RunError
from tools.judge import verdict_table
from tools.judge.reports import panels, summary, times, torques
from tools.judge.reports.page_model import PageModel, PageWindow, TimelineEvent
from tools.judge.reports.run_data import RunData, TimeAxis
from tools.judge.reports.signals import Span
from tools.judge.reports.summary import RunVerdict, TopicLoss
from tools.judge.reports.timeline import Timeline
from tools.judge.run_parts import zero_ns
from tools.logs.run_index import RunIndex
from tools.logs.run_log import PART_S, SEE_INFO, WHOLE, RunLog, RunPart, parts_of

HERE: Final = Path(__file__).parent
VENDOR: Final = HERE / "vendor" / "uplot"
STYLES: Final = (VENDOR / "uPlot.min.css", HERE / "page.css")
LIBRARY: Final = VENDOR / "uPlot.iife.min.js"
SCRIPTS: Final = tuple(
    HERE / f"{name}.js" for name in ("signals", "format", "overlay", "panel", "view", "page")
)

PANELS: Final = (
    panels.body, panels.hand, panels.feet, panels.states, panels.network, times.ages,
    panels.certificate, torques.joints, panels.heat, panels.harness, times.times,
)  # fmt: skip
"""What makes the panels, in the order of the page."""
BEFORE_FALL_S: Final = 3.0
"""A click on a fall shows this time before it."""

HELP: Final = "".join(
    f"<li>{line}</li>"
    for line in (
        "Drag in a plot to zoom all plots; double-click to show the whole run.",
        "Ctrl and wheel zoom at the cursor; Shift and wheel move the time shown.",
        "The legends show the values at the cursor. Dotted red lines are limits.",
        "Click in a plot to pin the cursor and to see time differences; Escape removes the pin.",
        "Click a name in a legend to hide or show its line; with Ctrl, to show it alone.",
        "Keys in a plot: arrows move the cursor, with Shift the time shown; Enter pins.",
        "Keys in a plot: + and &minus; zoom; 0 shows the whole run.",
    )
)

POLICY: Final = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"
)
"""Makes the browser refuse every request to another place."""


class Page:
    """The page of a run, whose parts are taken one after the other."""

    def __init__(self, axis: TimeAxis | None = None) -> None:
        self._axis = axis
        self._model: PageModel | None = None
        self._about: RunData | None = None
        self._has_first = self._has_last = False
        self._armed_s: float | None = None
        self._timeline = Timeline()
        self._judge = summary.Judge()
        self._losses = summary.MessageLosses()

    def add(self, log: RunLog) -> None:
        """Add a run, or the next part of it."""
        run = RunData(log, self._axis, self._armed_s)
        armed_s = run.armed_s()
        self._armed_s = armed_s if math.isfinite(armed_s) else None
        self._has_first |= log.is_first
        self._has_last |= log.is_last
        if self._about is None or (self._about.course is None and run.course is not None):
            self._about = run  # a part in which the scenario runs names the time axis
        self._model = self._model or PageModel(run.span)
        span = None if log.is_whole else run.span
        self._model.window = PageWindow(run.begin_s, run.end_s, span)
        for make in PANELS:
            for panel in make(run):
                self._model.add(panel)
        self._timeline.add(run)
        self._judge.add(run)
        self._losses.add(run)

    def html(self) -> str:
        """Return the page."""
        run, model = self._about, self._model
        assert run is not None  # noqa: S101 - a run has a part
        assert model is not None  # noqa: S101
        log = run.log
        events = self._timeline.events(run.span)
        plots, left_out = model.as_data(events)
        verdict = self._judge.verdict(whole=self._has_first and self._has_last)
        name = log.metadata["run"].get("scenario") or log.path.name
        fell_s = next((row.t for row in events if row.kind == "fall"), None)
        parts = (
            _head(run, verdict, name),
            _tools(run, fell_s),
            f'<div class="work">{_timeline(events)}<main id="panels"></main></div>',
            _left_out(left_out),
            _message_losses(run, self._losses.rows(log.robot)),
            _inputs(run),
        )
        data = json.dumps(plots, separators=(",", ":"), allow_nan=False)
        prefix = "" if verdict.good is None else f"{verdict.sentence}: "
        return _document(f"{prefix}{name}, {log.robot}", "\n".join(parts), data)


def render(log: RunLog) -> str:
    """Return the page of a run that is in memory."""
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
    """Return the page of a run, or of a part of it, with `part_s` of it in memory at a time."""
    zero = zero_ns(index)
    offset_s = (index.span_ns[0] - zero) / NS_PER_S
    begin_s, end_s = max(part.begin_s, 0.0), min(part.end_s, index.length_s)
    page = Page(TimeAxis(zero, Span(begin_s + offset_s, end_s + offset_s)))
    heard = False
    for log in parts_of(index, part, part_s=part_s, done=done):
        heard = heard or bool(log.keys())
        page.add(log)
    if not heard:
        raise RunError(f"{index.path}: has no message in this part; {SEE_INFO}")
    return page.html()


def _document(title: str, body: str, data: str) -> str:
    style = "\n".join(path.read_text(encoding="utf-8") for path in STYLES)
    library = LIBRARY.read_text(encoding="utf-8")
    script = "\n".join(path.read_text(encoding="utf-8") for path in SCRIPTS)
    safe = data.replace("<", "\\u003c")  # so the data hold no end tag
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
<script id="uplot">{library}</script>
<script>
{script}</script>
</body>
</html>
"""


def _head(run: RunData, verdict: RunVerdict, name: str) -> str:
    word = {True: "good", False: "bad", None: "none"}[verdict.good]
    rows = "".join(
        f"<div><dt>{escape(key)}</dt><dd>{escape(value)}</dd></div>"
        for key, value in summary.head(run)
    )
    caution = f'<p class="caution">{escape(verdict.caution)}</p>' if verdict.caution else ""
    table = ""
    if verdict.rows:
        marks = [mark for *_, mark in verdict.rows if mark]
        over = sum(mark.startswith(verdict_table.OVER) for mark in marks)
        count = f"{over} of {len(marks)} over" if over else f"all {len(marks)} ok"
        names = ("figure", "measured", "limit", "")
        cells = _table(names, verdict.rows, numbers=(1, 2))
        table = _details(f"Figures against their limits: {count}", cells, is_open=True)
    return (
        f"<header><h1>{escape(run.log.robot)}: {escape(name)}</h1>"
        f'<p class="verdict {word}" id="verdict">{escape(verdict.sentence)}</p>{caution}'
        f'<div class="head">{table}<dl>{rows}</dl></div></header>'
    )


def _tools(run: RunData, fell_s: float | None) -> str:
    begin, end = run.span
    buttons = "".join(
        f'<button type="button" data-do="{do}" title="{title}" aria-label="{title}">{text}</button>'
        for do, text, title in (
            ("left", "&larr;", "earlier"), ("right", "&rarr;", "later"),
            ("in", "+", "zoom in"), ("out", "&minus;", "zoom out"), ("all", "all", "whole run"),
        )
    )  # fmt: skip
    if fell_s is not None:
        title = f"the last {BEFORE_FALL_S:g} s before the fall"
        buttons += (
            f'<button type="button" data-t="{fell_s:.4f}" data-before="{BEFORE_FALL_S:g}" '
            f'title="{title}" aria-label="{title}">fall</button>'
        )
    field = '<input type="number" step="any" min="{0:.3f}" max="{1:.3f}" value="{2:.3f}" id="{3}">'
    fields = (
        f'<span class="range"><label>from {field.format(begin, end, begin, "from")}</label>'
        f"<label>to {field.format(begin, end, end, 'to')} s</label></span>"
        '<select id="goto" aria-label="go to a panel"><option value="">go to ...</option></select>'
    )
    return (
        f'<nav class="tools" aria-label="time shown"><span class="buttons">{buttons}</span>{fields}'
        f'<output id="cursor"></output></nav>'
        f'<details class="hint"><summary>{escape(run.axis[0].upper() + run.axis[1:])}. '
        f"How to read and zoom</summary><ul>{HELP}</ul></details>"
        "<noscript><p>The plots need JavaScript; verdict, timeline and tables do not.</p>"
        "</noscript>"
    )


def _left_out(panels_without_data: Sequence[tuple[str, str]]) -> str:
    if not panels_without_data:
        return ""
    rows = "".join(f"<li>{escape(title)}: {escape(why)}</li>" for title, why in panels_without_data)
    return f'<section id="left-out"><h2>Panels without data</h2><ul>{rows}</ul></section>'


def _timeline(events: Sequence[TimelineEvent]) -> str:
    rows = "".join(
        f'<li class="{escape(row.kind)}"><button type="button" data-t="{row.t:.4f}"'
        f"{_before(row)}>"
        f"<time>{row.t:.3f} s</time> <span>{escape(row.text)}</span></button></li>"
        for row in events
    )
    rows = rows or "<li>no events</li>"
    return (
        '<section id="timeline"><h2>Timeline</h2>'
        f'<p class="hint">Click a row to show its time in the plots.</p><ol tabindex="0" '
        f'aria-label="timeline">{rows}</ol></section>'
    )


def _before(row: TimelineEvent) -> str:
    """Return the time to show before an event, if it is a fall; other events have the default."""
    return f' data-before="{BEFORE_FALL_S:g}"' if row.kind == "fall" else ""


def _message_losses(run: RunData, rows: Sequence[TopicLoss]) -> str:
    missing = sum(row.counted.missing for row in rows)
    cells = []
    for name, rate_hz, nominal_hz, count in rows:
        rate = f"{rate_hz:.1f}" if rate_hz is not None else ""
        nominal = f"{nominal_hz:g}" if nominal_hz else ""
        counts = map(str, (count.missing, count.gaps, count.restarts))
        cells.append((name, str(count.count), rate, nominal, *counts))
    title = f"Messages: {missing} lost on the way to the log" if missing else "Messages: none lost"
    names = ("topic", "messages", "Hz", "nominal Hz", "lost", "gaps", "restarts")
    damage = "".join(f"<li>{escape(line)}</li>" for line in summary.damage(run))
    body = (f"<ul>{damage}</ul>" if damage else "") + _table(names, cells, numbers=range(1, 7))
    return f'<section id="lost">{_details(title, body, is_open=bool(missing or damage))}</section>'


def _inputs(run: RunData) -> str:
    parts = [_details(name, f"<pre>{escape(text)}</pre>") for name, text in summary.files(run)]
    installed = summary.packages(run)
    if installed:
        table = _table(("package", "version"), installed, numbers=())
        parts.append(_details(f"{len(installed)} packages", table))
    return f'<section id="inputs"><h2>Inputs of the run</h2>{"".join(parts)}</section>'


def _details(title: str, body: str, *, is_open: bool = False) -> str:
    flag = " open" if is_open else ""
    return f"<details{flag}><summary>{escape(title)}</summary>{body}</details>"


def _table(names: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: Sequence[int]) -> str:
    head = "".join(
        f'<th scope="col"{_class("", number=column in numbers)}>{escape(name)}</th>'
        for column, name in enumerate(names)
    )
    body = ""
    for row in rows:
        cells = "".join(
            f"<td{_class(value, number=column in numbers)}>{escape(value)}</td>"
            for column, value in enumerate(row)
        )
        body += f"<tr>{cells}</tr>"
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="wide">{table}</div>'


def _class(value: str, *, number: bool) -> str:
    word = value.partition(",")[0]
    kind = "n" if number else word if word in (verdict_table.OK, verdict_table.OVER) else ""
    return f' class="{kind}"' if kind else ""
