"""The page of the joint service's state machine, from `services.joint.failsafe`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from services.joint.failsafe import TRANSITIONS, Event
from shared.bus.messages import Mode
from tools.dev.reference.markdown import cell_docs, table

_INTRODUCTION: Final = """\
# Modes of a joint service

The joint service acts on one event a cycle, the gravest first (the table's order). An event that a
mode does not list changes nothing. The reasons behind the machine: [](../architecture.md#modes).
"""


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
