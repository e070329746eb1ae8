"""Tables of Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator


def table(headings: str, rows: Iterable[Iterable[object]]) -> Iterator[str]:
    """Yield the lines of a table; `|` separates the headings."""
    columns = [heading.strip() for heading in headings.split("|")]
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    yield from (f"| {' | '.join(map(str, row))} |" for row in rows)
