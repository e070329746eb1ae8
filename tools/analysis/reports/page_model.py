"""Contents of a page as plain values: panels with lines, bars and a timeline. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from tools.analysis.reports.signals import Array, Span, encode_signal, segments


class Line(NamedTuple):
    """One line of a panel."""

    label: str
    t: Array
    values: Array
    colour: int
    hidden: bool = False
    """True: not shown until the user switches it on in the legend."""
    dashed: bool = False


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


class PageModel:
    """Panels of a page, in the order in which they are added."""

    def __init__(self, span: Span) -> None:
        self.span = span
        self.signals: list[dict[str, Any]] = []
        self.panels: list[dict[str, Any]] = []
        self._indices: dict[tuple[Any, ...], int] = {}
        self.left_out: list[tuple[str, str]] = []
        """(title, reason) of each panel for which the log has no data."""

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
    ) -> None:
        """Add a panel of lines; a panel without data is left out.

        Args:
            title: title of the panel.
            unit: unit of the value axis.
            lines: lines; those without data are left out.
            limits: levels.
            reach: upper end of the value axis; lines may go beyond it.
            note: an explanation for readers who do not know the panel.
            if_empty: reason to state if the panel has no data.
        """
        found = self._lines(lines)
        if not found:
            self.left_out.append((title, if_empty))
            return
        self.panels.append(
            _panel("plot", title, note, unit=unit, lines=found, limits=_levels(limits), reach=reach)
        )

    def choice(
        self,
        title: str,
        unit: str,
        group: str,
        choices: Mapping[str, tuple[Sequence[Line], Sequence[LevelLine]]],
        *,
        initial: str,
        note: str = "",
        if_empty: str = "",
    ) -> None:
        """Add a panel that shows one of several sets of lines at a time.

        Args:
            title: title of the panel.
            unit: unit of the value axis.
            group: panels of one group show the same choice.
            choices: lines and levels by name.
            initial: name of the set that is shown first.
            note: an explanation for readers who do not know the panel.
            if_empty: reason to state if the panel has no data.
        """
        found = [
            {"label": label, "lines": self._lines(lines), "limits": _levels(limits)}
            for label, (lines, limits) in choices.items()
        ]
        found = [choice for choice in found if choice["lines"]]
        if not found:
            self.left_out.append((title, if_empty))
            return
        labels = [choice["label"] for choice in found]
        index = labels.index(initial) if initial in labels else 0
        self.panels.append(
            _panel("plot", title, note, unit=unit, group=group, choices=found, initial=index)
        )

    def bars(
        self,
        title: str,
        rows: Sequence[BarRow],
        names: type[IntEnum],
        colours: Mapping[int, str],
        *,
        if_empty: str = "",
    ) -> None:
        """Add a panel of coloured bars; rows without data are left out.

        Args:
            title: title of the panel.
            rows: rows from top to bottom.
            names: names of the codes.
            colours: name of the colour of each code.
            if_empty: reason to state if the panel has no data.
        """
        found: list[dict[str, Any]] = []
        for row in rows:
            inside = (row.t >= self.span.begin) & (row.t <= self.span.end)
            spans = segments(row.t[inside], np.asarray(row.codes[inside], dtype=np.int64))
            if spans:
                found.append({"label": row.label, "spans": spans})
        if not found:
            self.left_out.append((title, if_empty))
            return
        used = sorted({int(span[2]) for row in found for span in row["spans"]})
        codes = {
            str(code): [_name(names, code), colours.get(code, "idle")] for code in used
        }  # an unknown code comes from another version
        self.panels.append(_panel("bars", title, "", rows=found, codes=codes))

    def as_data(self, events: Sequence[TimelineEvent]) -> dict[str, Any]:
        """Return the data of the page's plots."""
        return {
            "span": [self.span.begin, self.span.end],
            "grid": self.span.grid,
            "signals": self.signals,
            "panels": self.panels,
            "marks": [[row.t, row.kind, row.mark] for row in events if row.mark],
        }

    def _lines(self, lines: Sequence[Line]) -> list[dict[str, Any]]:
        found = []
        for line in lines:
            signal = encode_signal(line.t, line.values, self.span)
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
        """Return the index of a signal; equal signals are stored once."""
        index = self._indices.setdefault(tuple(signal.values()), len(self.signals))
        if index == len(self.signals):
            self.signals.append(signal)
        return index


def _levels(limits: Sequence[LevelLine]) -> list[dict[str, Any]]:
    return [limit._asdict() for limit in limits]


def _panel(kind: str, title: str, note: str, **rest: Any) -> dict[str, Any]:
    return {"kind": kind, "title": title, "note": note, **rest}


def _name(names: type[IntEnum], code: int) -> str:
    try:
        return names(code).name
    except ValueError:
        return f"unknown ({code})"
