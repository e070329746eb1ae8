"""Tables of Markdown, and docstrings as their cells."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator

from tools.flags import field_docs


def table(headings: str, rows: Iterable[Iterable[object]]) -> Iterator[str]:
    """Yield the lines of a table; `|` separates the headings."""
    columns = [heading.strip() for heading in headings.split("|")]
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    yield from (f"| {' | '.join(map(str, row))} |" for row in rows)


def cell_docs(struct: type) -> dict[str, str]:
    """Return the docstrings of a struct's fields, for cells of a table."""
    return {name: one_line(text) for name, text in field_docs(struct).items()}


def summary(documented: object) -> str:
    """Return the whole docstring in one line."""
    return one_line(inspect.getdoc(documented) or "")


def one_line(text: str) -> str:
    """Return the text on one line, for a table's cell; names of pages become links."""
    text = " ".join(text.split()).replace("|", "\\|")
    return re.sub(r"docs/(\w[\w-]*)\.md(#[\w-]+)?", r"[\1](../\1.md\2)", text)
