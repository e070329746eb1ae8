"""The page of faults: what goes wrong, what then happens, what a person does, from the tables."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from shared.config.files import load
from shared.places import DEFAULT_CONFIG
from tools.dev.reference.markdown import one_line, table
from tools.verbs.faults import sections

_INTRODUCTION: Final = """\
# Faults

`xrl faults` prints this page's tables. Lockstep tests hold the robot to each row of the first two
tables, and `xrl study crash` does so live. A module that lost torque is never re-armed
automatically, even if its service restarts: a person mends the cause, then restarts the service.
"""


def page() -> Iterator[str]:
    """Yield the page in Markdown."""
    yield _INTRODUCTION
    for title, about, headings, rows in sections(load(DEFAULT_CONFIG).trips):
        yield f"## {title}\n\n{about}\n"
        cells = ((f"`{name}`", *map(one_line, others)) for name, *others in rows)
        yield from table(" | ".join(headings), cells)
        yield ""
