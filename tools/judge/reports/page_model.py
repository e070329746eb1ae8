"""Contents of a page as plain values: panels with lines, bars and a timeline. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import msgspec
import numpy as np

from shared.arrays import Array
from shared.bus.messages import name_of
from tools.judge.reports.signals import GAP_S, Span, encode_signal, segments, thinned


class Line(NamedTuple):
    """One line of a panel."""

    label: str
    t: Array
    values: Array
    colour: int
    hidden: bool = False
    """True: not shown until the user switches it on in the legend."""
    dashed: bool = False
    counts_up: bool = False
    """True: a counter; a part of a run goes on from where the part before it ended."""


class LevelLine(NamedTuple):
    """A horizontal line: a limit or another level to compare the lines with."""

    value: float
    label: str
    shown: bool = True
    """False: the value axis does not extend to include it."""


class BarRow(NamedTuple):
    """One row of a bar panel."""

    label: str
    t: Array
    codes: Array


class Lines(NamedTuple):
    """A set of lines, with the levels to compare them with."""

    lines: Sequence[Line]
    limits: Sequence[LevelLine] = ()


class Panel(msgspec.Struct, frozen=True):
    """What a run, or a part of it, has for a panel; of a long run a panel goes on part by part."""

    title: str
    unit: str = ""
    note: str = ""
    """An explanation for readers who do not know the panel."""
    if_empty: str = ""
    """Why it is left out, where the log has no data for it."""


class Plot(Panel, frozen=True, kw_only=True):
    """Lines over one value axis; those without data are left out."""

    lines: Sequence[Line]
    limits: Sequence[LevelLine] = ()
    reach: float | None = None
    """Upper end of the value axis; lines may go beyond it."""
    needs_count: bool = False
    """A panel whose lines are all zero is left out too."""


class Choice(Panel, frozen=True, kw_only=True):
    """One of several sets of lines at a time; panels of one group show the same."""

    group: str
    choices: Mapping[str, Lines]
    initial: str
    """Set that is shown first."""
    weight: float = 0.0
    """The heaviest of several parts of a run says what is shown first."""


class Bars(Panel, frozen=True, kw_only=True):
    """Coloured bars, in rows from top to bottom; rows without data are left out."""

    rows: Sequence[BarRow]
    names: type[IntEnum]
    """Names of the codes."""
    colours: Mapping[int, str]
    """Name of the colour of each code."""


class TimelineEvent(NamedTuple):
    """One row of the timeline."""

    t: float
    kind: str
    """`kill`, `restart`, `push`, `fault`, `network`, `estop`, `fall`: also marked in the plots;
    `limit`, `bad`, `note`: only in the timeline."""
    text: str
    mark: str = ""
    """Label of the mark in the plots; empty: no mark."""


class PageWindow(NamedTuple):
    """The part of a run that is being added to a page."""

    begin_s: float = -np.inf
    end_s: float = np.inf
    span: Span | None = None
    """Thins lines to the resolution of this page; None: they stay as they are."""

    def of(self, t: Array, values: Array) -> tuple[Array, Array]:
        """Return the samples of a line inside it."""
        inside = (t >= self.begin_s) & (t < self.end_s)
        if not inside.all():
            t, values = t[inside], values[inside]
        return (t, values) if self.span is None else thinned(t, values, self.span)


class _Trace:
    """One line over all parts of a run."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self.parts: list[tuple[Array, Array]] = []
        self._count = 0.0

    def add(self, line: Line, window: PageWindow) -> None:
        """Add what a part of the run has of it."""
        values = line.values
        if line.counts_up:  # what it counted before the part is in the part before
            values = values - (values[line.t < window.begin_s][-1:].sum())
        t, values = window.of(line.t, values)
        if not len(t):
            return
        if line.counts_up:
            values = values + self._count
            self._count = float(values[-1])
        self.parts.append((t, values))


class _Gathered:
    """A panel over all parts of a run."""

    def __init__(self, panel: Panel) -> None:
        self.panel = panel
        """The newest part's."""
        self._traces: dict[str, dict[str, _Trace]] = {}
        """By choice and label; the only choice of a plot is ""."""
        self._limits: dict[str, Sequence[LevelLine]] = {}
        self._bars: dict[str, list[list[float]]] = {}
        self._initial, self._weight = "", -np.inf

    def add(self, panel: Panel, window: PageWindow, span: Span) -> None:
        """Add what a part of the run has of it."""
        self.panel = panel
        choices: Mapping[str, Lines] = {}
        if isinstance(panel, Plot):
            choices = {"": Lines(panel.lines, panel.limits)}
        elif isinstance(panel, Choice):
            choices = panel.choices
            if panel.weight > self._weight:
                self._initial, self._weight = panel.initial, panel.weight
        elif isinstance(panel, Bars):
            begin_s = max(span.begin, window.begin_s)
            for row in panel.rows:
                inside = (row.t >= begin_s) & (row.t <= span.end) & (row.t < window.end_s)
                spans = segments(row.t[inside], np.asarray(row.codes[inside], dtype=np.int64))
                _go_on(self._bars.setdefault(row.label, []), spans)
        for name, (lines, limits) in choices.items():
            self._limits[name] = limits
            traces = self._traces.setdefault(name, {})
            for line in lines:
                traces.setdefault(line.label, _Trace(line)).add(line, window)

    def as_data(self, signals: _Signals) -> dict[str, Any] | None:
        """Return it as the page stores it; None if it has no data."""
        panel = self.panel
        head = {"title": panel.title, "note": panel.note}
        if isinstance(panel, Bars):
            rows = [
                {"label": label, "spans": spans} for label, spans in self._bars.items() if spans
            ]
            used = sorted({int(span[2]) for spans in self._bars.values() for span in spans})
            codes = {
                str(code): [name_of(panel.names, code), panel.colours.get(code, "idle")]
                for code in used
            }
            return {"kind": "bars", **head, "rows": rows, "codes": codes} if rows else None
        if isinstance(panel, Plot) and panel.needs_count and self._is_zero():
            return None
        choices = [
            {"label": name, "lines": lines, "limits": [row._asdict() for row in self._limits[name]]}
            for name, traces in self._traces.items()
            if (lines := signals.lines(traces.values()))
        ]
        if not choices:
            return None
        plot = {"kind": "plot", **head, "unit": panel.unit}
        if isinstance(panel, Choice):
            labels = [choice["label"] for choice in choices]
            index = labels.index(self._initial) if self._initial in labels else 0
            return plot | {"group": panel.group, "choices": choices, "initial": index}
        del choices[0]["label"]
        return plot | choices[0] | {"reach": panel.reach if isinstance(panel, Plot) else None}

    def _is_zero(self) -> bool:
        traces = self._traces[""].values()
        return not any(values.any() for trace in traces for _, values in trace.parts)


class PageModel:
    """Panels of a page, in the order in which they are added first; a long run part by part."""

    def __init__(self, span: Span) -> None:
        self.span = span
        self.window = PageWindow()
        """What of the data added is taken."""
        self._panels: dict[str, _Gathered] = {}

    def add(self, panel: Panel) -> None:
        """Add a panel, or what the next part of the run has of it."""
        self._panels.setdefault(panel.title, _Gathered(panel)).add(panel, self.window, self.span)

    def as_data(
        self, events: Sequence[TimelineEvent]
    ) -> tuple[dict[str, Any], list[tuple[str, str]]]:
        """Return the data of the page's plots; title and reason of each panel without data."""
        signals = _Signals(self.span)
        found = [(row.panel, row.as_data(signals)) for row in self._panels.values()]
        data = {
            "span": [self.span.begin, self.span.end],
            "grid": self.span.grid,
            "signals": signals.rows,
            "panels": [data for _, data in found if data is not None],
            "marks": [[row.t, row.kind, row.mark] for row in events if row.mark],
        }
        return data, [(panel.title, panel.if_empty) for panel, data in found if data is None]


class _Signals:
    """The signals of a page; equal ones are stored once."""

    def __init__(self, span: Span) -> None:
        self.rows: list[dict[str, Any]] = []
        self._span = span
        self._indices: dict[tuple[Any, ...], int] = {}

    def lines(self, traces: Iterable[_Trace]) -> list[dict[str, Any]]:
        """Return lines as the page stores them; those without a finite value are left out."""
        found = []
        for trace in traces:
            if not trace.parts:
                continue
            t, values = map(np.concatenate, zip(*trace.parts, strict=True))
            signal, line = encode_signal(t, values, self._span), trace.line
            if signal is not None:
                found.append({
                    "label": line.label, "signal": self._index(signal), "colour": line.colour,
                    "hidden": line.hidden, "dashed": line.dashed,
                })  # fmt: skip
        return found

    def _index(self, signal: dict[str, Any]) -> int:
        index = self._indices.setdefault(tuple(signal.values()), len(self.rows))
        if index == len(self.rows):
            self.rows.append(signal)
        return index


def _go_on(spans: list[list[float]], more: list[list[float]]) -> None:
    """Add intervals behind others; one that goes on is not divided."""
    if spans and more and spans[-1][2] == more[0][2] and more[0][0] - spans[-1][1] <= GAP_S:
        spans[-1][1] = more[0][1]
        more = more[1:]
    spans += more
