"""Contents of a page as plain values: panels with lines, bars and a timeline. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from shared.bus.code_names import name_of
from tools.judge.reports.signals import GAP_S, Array, Span, encode_signal, segments, thinned


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


class TimelineEvent(NamedTuple):
    """One row of the timeline."""

    t: float
    kind: str
    """`kill`, `restart`, `push`, `fault`, `network`, `estop`, `fall`: also marked in the plots;
    `limit`, `bad`, `note`: only in the timeline."""
    text: str
    mark: str = ""
    """Label of the mark in the plots; empty: no mark."""


class _Trace:
    """One line over all parts of a run."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self._t: list[Array] = []
        self._values: list[Array] = []
        self._count = 0.0

    def add(self, t: Array, values: Array) -> None:
        """Add what a part of the run has of it."""
        if not len(t):
            return
        if self.line.counts_up:
            values = values + self._count
            self._count = float(values[-1])
        self._t.append(t)
        self._values.append(values)

    def signal(self, span: Span) -> dict[str, Any] | None:
        """Return it as the page stores it; None if it has no finite value."""
        if not self._t:
            return None
        return encode_signal(np.concatenate(self._t), np.concatenate(self._values), span)

    def is_zero(self) -> bool:
        return not any(values.any() for values in self._values)


class _Lines:
    """Lines of a panel or of one choice, in the order in which they came first."""

    def __init__(self) -> None:
        self.traces: dict[str, _Trace] = {}
        self.limits: Sequence[LevelLine] = ()

    def add(self, lines: Sequence[Line], limits: Sequence[LevelLine], window: PageWindow) -> None:
        """Add the lines of a part of the run."""
        self.limits = limits
        for line in lines:
            values = line.values
            if line.counts_up:  # what it counted before the part is in the part before
                values = values - (values[line.t < window.begin_s][-1:].sum())
            trace = self.traces.setdefault(line.label, _Trace(line))
            trace.add(*window.of(line.t, values))

    def is_zero(self) -> bool:
        """Return True if no line ever leaves zero."""
        return all(trace.is_zero() for trace in self.traces.values())


class _Panel:
    """A panel of lines, of one of several sets of lines, or of bars."""

    def __init__(self, kind: str, title: str, unit: str, note: str, if_empty: str) -> None:
        self.kind, self.title, self.unit = kind, title, unit
        self.note, self.if_empty = note, if_empty
        self.lines = _Lines()
        self.reach: float | None = None
        self.needs_count = False
        self.group = ""
        self.choices: dict[str, _Lines] = {}
        self.initial, self.weight = "", -np.inf
        self.bars: dict[str, list[list[float]]] = {}
        self.names: type[IntEnum] = IntEnum
        self.colours: Mapping[int, str] = {}


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


class PageModel:
    """Panels of a page, in the order in which they are added.

    A long run is added part by part: a panel or line that is there already goes on.
    """

    def __init__(self, span: Span) -> None:
        self.span = span
        self.window = PageWindow()
        """What of the data added is taken."""
        self._panels: dict[str, _Panel] = {}
        self._encoded_panels: tuple[list[tuple[_Panel, dict[str, Any] | None]], _Signals] | None = (
            None
        )

    def plot(
        self,
        title: str,
        unit: str,
        lines: Sequence[Line],
        *,
        limits: Sequence[LevelLine] = (),
        reach: float | None = None,
        note: str = "",
        if_empty: str = "",
        needs_count: bool = False,
    ) -> None:
        """Add a panel of lines; a panel without data is left out.

        The value axis ends at `reach`, and lines may go beyond it. With `needs_count` a panel whose
        lines are all zero is left out too. `if_empty` says why there is no data.
        """
        panel = self._panel("plot", title, unit, note, if_empty)
        panel.reach, panel.needs_count = reach, needs_count
        panel.lines.add(lines, limits, self.window)

    def choice(
        self,
        title: str,
        unit: str,
        group: str,
        choices: Mapping[str, tuple[Sequence[Line], Sequence[LevelLine]]],
        *,
        initial: str,
        weight: float = 0.0,
        note: str = "",
        if_empty: str = "",
    ) -> None:
        """Add a panel that shows one of several sets of lines at a time.

        Panels of one group show the same choice. Of several parts of a run, that of the greatest
        weight says what is shown first.
        """
        panel = self._panel("choice", title, unit, note, if_empty)
        panel.group = group
        if weight > panel.weight:
            panel.initial, panel.weight = initial, weight
        for label, (lines, limits) in choices.items():
            panel.choices.setdefault(label, _Lines()).add(lines, limits, self.window)

    def bars(
        self,
        title: str,
        rows: Sequence[BarRow],
        names: type[IntEnum],
        colours: Mapping[int, str],
        *,
        if_empty: str = "",
    ) -> None:
        """Add a panel of coloured bars; rows without data are left out."""
        panel = self._panel("bars", title, "", "", if_empty)
        panel.names, panel.colours = names, colours
        for row in rows:
            begin_s = max(self.span.begin, self.window.begin_s)
            inside = (row.t >= begin_s) & (row.t <= self.span.end) & (row.t < self.window.end_s)
            spans = segments(row.t[inside], np.asarray(row.codes[inside], dtype=np.int64))
            _go_on(panel.bars.setdefault(row.label, []), spans)

    def leave_out(self, title: str, why: str) -> None:
        """Note that the log has no data for a panel."""
        self._panel("plot", title, "", "", why)

    def as_data(self, events: Sequence[TimelineEvent]) -> dict[str, Any]:
        """Return the data of the page's plots."""
        panels, signals = self._encoded()
        return {
            "span": [self.span.begin, self.span.end],
            "grid": self.span.grid,
            "signals": signals.rows,
            "panels": [data for _, data in panels if data is not None],
            "marks": [[row.t, row.kind, row.mark] for row in events if row.mark],
        }

    @property
    def left_out(self) -> list[tuple[str, str]]:
        """(title, reason) of each panel for which the log has no data."""
        panels, _ = self._encoded()
        return [(panel.title, panel.if_empty) for panel, data in panels if data is None]

    def _panel(self, kind: str, title: str, unit: str, note: str, if_empty: str) -> _Panel:
        self._encoded_panels = None
        found = self._panels.get(title)
        if found is None:
            found = self._panels[title] = _Panel(kind, title, unit, note, if_empty)
        elif unit:  # a part before it may have had nothing to show
            found.unit, found.note, found.if_empty = unit, note, if_empty
        return found

    def _encoded(self) -> tuple[list[tuple[_Panel, dict[str, Any] | None]], _Signals]:
        if self._encoded_panels is None:
            signals = _Signals(self.span)
            panels = [(panel, _data(panel, signals)) for panel in self._panels.values()]
            self._encoded_panels = panels, signals
        return self._encoded_panels


class _Signals:
    """The signals of a page; equal ones are stored once."""

    def __init__(self, span: Span) -> None:
        self.rows: list[dict[str, Any]] = []
        self._span = span
        self._indices: dict[tuple[Any, ...], int] = {}

    def lines(self, lines: _Lines) -> list[dict[str, Any]]:
        """Return lines as the page stores them; those without data are left out."""
        found = []
        for trace in lines.traces.values():
            signal, line = trace.signal(self._span), trace.line
            if signal is not None:
                found.append(
                    {
                        "label": line.label,
                        "signal": self._index(signal),
                        "colour": line.colour,
                        "hidden": line.hidden,
                        "dashed": line.dashed,
                    }
                )
        return found

    def _index(self, signal: dict[str, Any]) -> int:
        index = self._indices.setdefault(tuple(signal.values()), len(self.rows))
        if index == len(self.rows):
            self.rows.append(signal)
        return index


def _data(panel: _Panel, signals: _Signals) -> dict[str, Any] | None:
    """Return a panel as the page stores it; None if it has no data."""
    head = {"title": panel.title, "note": panel.note}
    if panel.kind == "bars":
        rows = [{"label": label, "spans": spans} for label, spans in panel.bars.items() if spans]
        used = sorted({int(span[2]) for spans in panel.bars.values() for span in spans})
        names, colours = panel.names, panel.colours
        codes = {str(code): [name_of(names, code), colours.get(code, "idle")] for code in used}
        return {"kind": "bars", **head, "rows": rows, "codes": codes} if rows else None
    plot = {"kind": "plot", **head, "unit": panel.unit}
    if panel.kind == "choice":
        choices = [
            {"label": label, "lines": found, "limits": _levels(lines.limits)}
            for label, lines in panel.choices.items()
            if (found := signals.lines(lines))
        ]
        labels = [choice["label"] for choice in choices]
        index = labels.index(panel.initial) if panel.initial in labels else 0
        more = {"group": panel.group, "choices": choices, "initial": index}
        return plot | more if choices else None
    if panel.needs_count and panel.lines.is_zero():
        return None
    found = signals.lines(panel.lines)
    more = {"lines": found, "limits": _levels(panel.lines.limits), "reach": panel.reach}
    return plot | more if found else None


def _go_on(spans: list[list[float]], more: list[list[float]]) -> None:
    """Add intervals behind others; one that goes on is not divided."""
    if spans and more and spans[-1][2] == more[0][2] and more[0][0] - spans[-1][1] <= GAP_S:
        spans[-1][1] = more[0][1]
        more = more[1:]
    spans += more


def _levels(limits: Sequence[LevelLine]) -> list[dict[str, Any]]:
    return [limit._asdict() for limit in limits]
