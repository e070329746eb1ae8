"""Docstrings of a struct's fields: the string below each field in the class body."""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
import textwrap
from typing import Final

PACKAGES: Final = ("shared", "services", "tools", "tests")
"""Whose sources are ours."""


def field_docs(struct: type) -> dict[str, str]:
    """Return the docstring of each documented field, in one line, base classes included."""
    docs: dict[str, str] = {}
    for owner in reversed(struct.__mro__):
        if owner.__module__.partition(".")[0] in PACKAGES:
            docs |= _own_docs(owner)
    return docs


@functools.cache
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
            docs[target.id] = " ".join(text.split())
    return docs
