"""Tables of Markdown, and what stands in their cells: docstrings of structs and their fields."""

from __future__ import annotations

import ast
import inspect
import itertools
import re
import textwrap
from collections.abc import Iterable, Iterator


def table(headings: str, rows: Iterable[Iterable[object]]) -> Iterator[str]:
    """Yield the lines of a table; `|` separates the headings."""
    columns = [heading.strip() for heading in headings.split("|")]
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    yield from (f"| {' | '.join(map(str, row))} |" for row in rows)


def field_docs(struct: type) -> dict[str, str]:
    """Return the docstring below each field, in one line, base classes included."""
    docs: dict[str, str] = {}
    for owner in reversed(struct.__mro__):
        if owner.__module__.partition(".")[0] in ("shared", "services"):
            docs |= _own_docs(owner)
    return docs


def _own_docs(struct: type) -> dict[str, str]:
    tree = ast.parse(textwrap.dedent(inspect.getsource(struct)))
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef))
    docs = {}
    for field, below in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign):
            target: ast.expr = field.target
        elif isinstance(field, ast.Assign):  # a member of an enumeration
            target = field.targets[0]
        else:
            continue
        if isinstance(target, ast.Name) and isinstance(below, ast.Expr):
            text = ast.literal_eval(below.value)
            docs[target.id] = one_line(text)
    return docs


def summary(documented: object) -> str:
    """Return the whole docstring in one line."""
    return one_line(inspect.getdoc(documented) or "")


def one_line(text: str) -> str:
    """Return the text on one line, ready for a table's cell; names of pages become links."""
    text = " ".join(text.split()).replace("|", "\\|")
    return re.sub(r"docs/(\w[\w-]*)\.md(#[\w-]+)?", r"[\1](../\1.md\2)", text)
