"""Bar panel of the injected network impairments."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from enum import IntEnum
from typing import Final

import numpy as np

from shared.bus import topics
from shared.bus.traces import LinkEvent
from shared.clock import NS_PER_S
from shared.links import GROUPS
from tools.judge.reports.page_model import BarRow, PageModel
from tools.judge.reports.run_data import RunData
from tools.judge.reports.signals import GAP_S

NO_IMPAIRMENTS: Final = "no impairment in this log"


class ImpairedLink(IntEnum):
    """State of one direction of a link."""

    CLEAR = 0
    IMPAIRED = 1
    """Delayed, or lossy."""
    CUT = 2


COLOURS: Final[dict[int, str]] = {
    ImpairedLink.CLEAR: "good",
    ImpairedLink.IMPAIRED: "warn",
    ImpairedLink.CUT: "bad",
}
History = tuple[tuple[float, ImpairedLink], ...]


def add_network(run: RunData, model: PageModel) -> None:
    """Add the impaired directions; directions with equal histories share a row."""
    names_by_history: dict[History, list[str]] = defaultdict(list)
    events: list[LinkEvent] = run.log.messages(topics.LINK_EVENT)
    for name, history in histories(events, run.zero_ns).items():
        names_by_history[history].append(name)
    rows = [_row(run, label, history) for history, names in names_by_history.items()
            for label in _labels(names)]  # fmt: skip
    model.bars("Injected network impairments", rows, ImpairedLink, COLOURS, if_empty=NO_IMPAIRMENTS)


def histories(events: Iterable[LinkEvent], zero_ns: int) -> dict[str, History]:
    """Return (time in s, state from then on) of each direction that was ever impaired.

    A partition outweighs all other impairments (`shared.config.impairment.Direction`).
    """
    found: dict[str, list[tuple[float, ImpairedLink]]] = defaultdict(list)
    active: dict[str, dict[int, bool]] = defaultdict(dict)
    for event in events:
        cuts = active[event.link]
        if event.active:
            cuts[event.number] = event.partition
        else:
            cuts.pop(event.number, None)
        state = (
            ImpairedLink.CUT
            if any(cuts.values())
            else ImpairedLink.IMPAIRED
            if cuts
            else ImpairedLink.CLEAR
        )
        found[event.link].append(((event.t_ns - zero_ns) / NS_PER_S, state))
    return {name: tuple(history) for name, history in found.items()}


def _row(run: RunData, label: str, history: History) -> BarRow:
    """Return a history as samples that are close enough to form one bar."""
    begin, end = run.span
    changes = np.array([t for t, _ in history])
    codes = np.array([ImpairedLink.CLEAR, *(code for _, code in history)])
    t = np.union1d(np.arange(begin, end, GAP_S / 2), changes)
    return BarRow(label, t, codes[np.searchsorted(changes, t, side="right")])


def _labels(names: Iterable[str]) -> list[str]:
    """Return short labels: the largest groups that the directions cover, then the rest."""
    left, found = set(names), []
    for group, members in sorted(GROUPS.items(), key=lambda item: -len(item[1])):
        if set(members) <= left:
            found.append(group)
            left -= set(members)
    found += sorted(left)
    return [_short(name) for name in found]


def _short(name: str) -> str:
    sender, arrow, receiver = name.partition("->")
    if not arrow:
        return name
    return f"to {receiver}" if sender == "planner" else f"from {sender}"
