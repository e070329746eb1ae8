"""`python -m tools.dev.reference`: writes the generated pages of docs, or checks them."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from pathlib import Path
from textwrap import dedent
from typing import Any, Final

from services.joint.failsafe import TRANSITIONS, Event
from shared.arguments import FlagParser
from shared.bus.messages import Mode
from shared.config.files import load
from shared.exceptions import FAULT_EXIT_CODE
from shared.places import DEFAULT_CONFIG
from tools.cli import whole_parser
from tools.dev.reference import robot_file, topics
from tools.dev.reference.markdown import cell_docs, one_line, table
from tools.verb_table import VERBS
from tools.verbs.faults import sections as fault_sections

FOLDER: Final = Path(__file__).resolve().parents[3] / "docs" / "reference"
_FAULTS: Final = """\
# Faults

`xrl faults` prints these tables. `tests/lockstep/test_faults.py` tests each drive fault, and
`xrl study crash` tests drive faults and lost services live.
"""
_MODES: Final = """\
# Modes of a joint service

A joint service acts on the first of a cycle's events in this table. An empty cell means no change.
After `FALLEN` a module only damps. See [causes](topics.md#cause) and
[modes](../architecture.md#modes).
"""
_SHARED_BY: Final = 2
"""Minimum number of verbs with the same flag and meaning for a common description."""
_VERBS: Final = """\
# Verbs

`xrl` is `.venv/bin/xrl`. The scripts `demo`, `up`, `down`, `status` and `kill` in `deploy/` make
the environment if needed, then run the verb. `xrl --version` prints version and commit.
`xrl help VERB` and `xrl VERB --help` print a verb's help.

| exit code | meaning |
|---|---|
| 0 | success |
| 1 | a robot fell or is about to fall |
| 2 | an error, such as invalid input or a full disk; or a declined question |
| 3 | a check or part of the work failed, a figure missed its limit, or no message arrived |
| 70 | a bug in `xrl`: please report its traceback |
| 129 | the terminal closed, as after a dropped ssh session |
| 130, 141, 143 | Ctrl-C; closed output pipe (`xrl ... \\| head`); SIGTERM |

Tables in a pipe or a file have full width, without frames and colours. Control characters from
logs, the bus and file names are printed escaped, such as `\\u001b`.
"""


def _faults_page() -> Iterator[str]:
    yield _FAULTS
    for title, about, headings, rows in fault_sections(load(DEFAULT_CONFIG).trips):
        yield f"## {title}\n\n{about}\n"
        cells = ((f"`{name}`", *map(one_line, others)) for name, *others in rows)
        yield from table(" | ".join(headings), cells)
        yield ""


def _modes_page() -> Iterator[str]:
    docs = cell_docs(Event)
    rows = []
    for event in Event:
        cells = [_after(mode, event) for mode in Mode]
        if any(cells):
            about = f": {docs[event.name]}" if event.name in docs else ""
            rows.append([f"`{event.name}`{about}", *cells])
    headings = " | ".join(["event", *(f"in {mode.name}" for mode in Mode)])
    yield _MODES
    yield from table(headings, rows)


def _after(mode: Mode, event: Event) -> str:
    row = TRANSITIONS[mode].get(event)
    return row[0].name if row else ""


def _verbs_page() -> Iterator[str]:
    """Yield the page of the command line: each verb's flags and examples."""
    parsers = dict(_parsers(whole_parser()))
    flags = {name: dict(_flags(parser)) for name, parser in parsers.items()}
    count = Counter(row for rows in flags.values() for row in rows.items())
    shared = {row: None for row in count if count[row] >= _SHARED_BY}
    rows = ((f"[`{verb.name}`](#xrl-{verb.name.replace(' ', '-')})", verb.help) for verb in VERBS)
    yield _VERBS
    yield from table("verb | what it does", rows)
    yield "\n## Flags of several verbs\n"
    yield from table("flag | meaning", shared)
    for name, found in flags.items():
        own = [row for row in found.items() if row not in shared]
        also = [f"{flag.split()[0].rstrip('`')}`" for flag, _ in found.items() & shared.keys()]
        about, lines = (
            (text or "").splitlines()[1:]
            for text in (parsers[name].description, parsers[name].epilog)
        )
        if not (found or any(about) or lines):
            continue  # only a group of verbs
        yield f"\n## xrl {name}\n"
        yield from _about(about)
        if own:
            yield from table("flag | meaning", own)
            yield ""
        if also:
            yield f"Also {', '.join(sorted(also))}.\n"
        if lines:
            yield "\n".join(["```sh", *(line.strip() for line in lines), "```"])


def _about(lines: Iterable[str]) -> Iterator[str]:
    """Yield a description's paragraphs, and its indented lines as blocks of text."""
    for indented, group in groupby(filter(str.strip, lines), lambda line: line.startswith("  ")):
        text = dedent("\n".join(group)).strip()
        yield f"```text\n{text}\n```\n" if indented else text + "\n"


def _flags(parser: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    """Yield a parser's flags and arguments as its help names them, and their meaning."""
    formatter = parser._get_formatter()  # noqa: SLF001
    for action in parser._actions:  # noqa: SLF001
        hidden = not action.help or argparse.SUPPRESS in (action.help, action.dest)
        if not hidden and action.dest != "help":
            invocation = formatter._format_action_invocation(action)  # noqa: SLF001
            yield one_line(f"`{invocation}`"), one_line(formatter._expand_help(action))  # noqa: SLF001


def _parsers(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield name and parser of every verb below a parser."""
    actions = parser._subparsers._group_actions if parser._subparsers else []  # noqa: SLF001
    choices: list[Any] = [action.choices for action in actions]  # a dictionary for sub-parsers
    for found in choices:
        for below in found.values():
            yield below.prog.removeprefix("xrl "), below
            yield from _parsers(below)


PAGES: Final[dict[str, Callable[[], Iterable[str]]]] = {
    "topics.md": topics.page,
    "robot-file.md": robot_file.page,
    "verbs.md": _verbs_page,
    "faults.md": _faults_page,
    "modes.md": _modes_page,
}
"""Function that yields the lines of each generated file, by file name."""


def text_of(name: str) -> str:
    """Return the text of a generated file."""
    return "\n".join(PAGES[name]()).rstrip() + "\n"


def main() -> int:
    """Write the pages, or with `--check` report those that differ; return the exit code."""
    parser = FlagParser(
        prog="python -m tools.dev.reference",
        description="Write docs/reference from the code. A test checks that it is up to date.",
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help=f"write nothing; exit code {FAULT_EXIT_CODE} if a page is out of date",
    )
    args = parser.parse_args()
    old = []
    for name in PAGES:
        path, text = FOLDER / name, text_of(name)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            old.append(name)
            if not args.check:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
    for name in old:
        print(f"{'out of date' if args.check else 'written'}: docs/reference/{name}")
    return FAULT_EXIT_CODE if args.check and old else 0


if __name__ == "__main__":
    sys.exit(main())
