"""The page of the command line: each verb's own help, from its parser."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from typing import Any, Final

from tools.cli import whole_parser
from tools.dev.reference.markdown import table
from tools.verb_table import VERBS

_WIDTH: Final = "96"
_INTRODUCTION: Final = """\
# Verbs

`xrl` is `.venv/bin/xrl`; `./deploy/demo`, `up`, `down`, `status` and `kill` are the same verbs with
the environment made first. `xrl --version` prints version and commit, `xrl help VERB` what
`xrl VERB --help` does.

| exit code | meaning |
|---|---|
| 0 | success |
| 1 | a robot fell, or is about to fall; nothing else |
| 2 | bad input, a person declined, the fleet cannot start, or the system refused a request |
| 3 | a check found a fault or a difference, or no message came |
| 70 | a fault of `xrl` itself: please report its traceback |
| 129 | its terminal is gone, as after a dropped ssh session |
| 130, 141, 143 | Ctrl-C; the reader of its output ended (`xrl ... \\| head`); SIGTERM |

A pipe or a file gets whole tables, without frames and colours. Control characters in a log, on the
bus or in a file's name are printed escaped, such as `\\u001b`.
"""


def page() -> Iterator[str]:
    """Yield the page in Markdown."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = _WIDTH  # argparse wraps by it
    try:
        helps = list(_helps(whole_parser()))
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
    rows = ((f"[`{verb.name}`](#xrl-{verb.name.replace(' ', '-')})", verb.help) for verb in VERBS)
    yield _INTRODUCTION
    yield from table("verb | what it does", rows)
    for name, text in helps:
        yield f"\n## xrl {name}\n\n```text\n{text.rstrip()}\n```"


def _helps(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """Yield name and help of every verb below a parser."""
    actions = parser._subparsers._group_actions if parser._subparsers else []  # noqa: SLF001
    choices: list[Any] = [action.choices for action in actions]  # of sub-parsers it is a dictionary
    for found in choices:
        for below in found.values():
            yield below.prog.removeprefix("xrl "), below.format_help()
            yield from _helps(below)
