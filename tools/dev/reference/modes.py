"""The joint service's state machine: its table and its diagram, from `services.joint.failsafe`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Final

from services.joint.failsafe import TRANSITIONS, Event
from shared.bus.messages import Mode
from tools.dev.reference.markdown import cell_docs, table

_INTRODUCTION: Final = """\
# Modes of a joint service

The joint service acts on one event a cycle, the gravest first (the table's order). An event that a
mode does not list changes nothing. The reasons behind the machine: [](../architecture.md#modes).

![The state machine of a joint service](modes.svg)
"""

_BOX: Final = (120, 44)
_AT: Final = {
    Mode.DISARMED: (80, 60), Mode.HOLD: (330, 60), Mode.TRACK: (680, 60),
    Mode.DAMP: (330, 250), Mode.FAULT: (680, 250),
}  # fmt: skip
"""Centres of the boxes, px."""
_SIZE: Final = (860, 300)
_STYLE: Final = """\
<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7"
 orient="auto"><path d="M0 0 8 4 0 8z" fill="#777"/></marker></defs>
<style>
text{font:13px sans-serif;text-anchor:middle} .name{font-weight:600;fill:#fff}
.event{font-size:11px;fill:#777} .arrow{stroke:#777;fill:none;stroke-width:1.4}
</style>"""
_COLOUR: Final = {
    Mode.DISARMED: "#8a8f98", Mode.HOLD: "#2f6fd0", Mode.TRACK: "#2e9e5b",
    Mode.DAMP: "#d08a1f", Mode.FAULT: "#c8403a",
}  # fmt: skip


def page() -> Iterator[str]:
    """Yield the page in Markdown."""
    docs = cell_docs(Event)
    rows = []
    for event in Event:
        cells = [_after(mode, event) for mode in Mode]
        if any(cells):
            about = f": {docs[event.name]}" if event.name in docs else ""
            rows.append([f"`{event.name}`{about}", *cells])
    headings = " | ".join(["event", *(f"in {mode.name}" for mode in Mode)])
    yield _INTRODUCTION
    yield from table(headings, rows)


def _after(mode: Mode, event: Event) -> str:
    row = TRANSITIONS[mode].get(event)
    return row[0].name if row else ""


def diagram() -> Iterator[str]:
    """Yield the diagram as an SVG file."""
    width, height = _SIZE
    yield f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">'
    yield "<title>Modes of a joint service and the events between them</title>"
    yield _STYLE
    arrows: dict[tuple[Mode, Mode], list[Event]] = defaultdict(list)
    for before, row in TRANSITIONS.items():
        for event, (after, _) in row.items():
            arrows[before, after].append(event)
    for (before, after), events in arrows.items():
        yield _arrow(before, after, events)
    for mode, (x, y) in _AT.items():
        w, h = _BOX
        yield (
            f'<rect x="{x - w / 2:g}" y="{y - h / 2:g}" width="{w}" height="{h}" rx="8" '
            f'fill="{_COLOUR[mode]}"/><text class="name" x="{x}" y="{y + 5}">{mode.name}</text>'
        )
    yield "</svg>"


def _arrow(before: Mode, after: Mode, events: list[Event]) -> str:
    """Draw one arrow; of two that join the same boxes each keeps to the right of its way."""
    (x0, y0), (x1, y1) = _AT[before], _AT[after]
    length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    aside = 8.0 if before in {row[0] for row in TRANSITIONS[after].values()} else 0.0
    start, end = _edge(ux, uy), _edge(-ux, -uy)
    sx, sy = x0 + start[0] - uy * aside, y0 + start[1] + ux * aside
    ex, ey = x1 + end[0] - uy * aside, y1 + end[1] + ux * aside
    lines = _wrapped([event.name.lower().replace("_", " ") for event in events])
    if uy == 0.0:
        tx, top = (sx + ex) / 2, sy + 14 if ux > 0.0 else sy - 6 - 13 * (len(lines) - 1)
    elif ux != 0.0 and len(lines) > 1:  # below the crossing of the diagonals, where there is room
        tx, top = (sx + ex) / 2, (sy + ey) / 2 + 54
    else:
        along = 0.5 if ux == 0.0 else 0.25
        tx, top = sx + along * (ex - sx) + 14, sy + along * (ey - sy)
        top -= 6.5 * (len(lines) - 1)
    anchor = "middle" if uy == 0.0 or (ux != 0.0 and len(lines) > 1) else "start"
    texts = "".join(
        f'<text class="event" style="text-anchor:{anchor}" x="{tx:.0f}" y="{top + 13 * i:.0f}">'
        f"{line}</text>"
        for i, line in enumerate(lines)
    )
    line = f"M{sx:.0f} {sy:.0f} {ex:.0f} {ey:.0f}"
    return f'<path class="arrow" marker-end="url(#tip)" d="{line}"/>{texts}'


def _edge(ux: float, uy: float) -> tuple[float, float]:
    """Return where a ray from a box's centre leaves the box."""
    w, h = _BOX
    scale = min(
        w / 2 / abs(ux) if ux else float("inf"), (h / 2 + 2) / abs(uy) if uy else float("inf")
    )
    return ux * scale, uy * scale


def _wrapped(names: list[str], per_line: int = 2) -> list[str]:
    return [", ".join(names[i : i + per_line]) for i in range(0, len(names), per_line)]
