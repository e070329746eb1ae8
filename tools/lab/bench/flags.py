"""Flags that every command of `xrl bench` has, and the file that `--json` names."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from shared.atomic_file import replace_file
from tools.number_arguments import count


def add_flags(parser: argparse.ArgumentParser, rounds: int, *, nested: bool = False) -> None:
    """Add `--rounds` and `--json`.

    Args:
        parser: of the verb, or of a command below it.
        rounds: what the help calls the default; without the flag the argument is None.
        nested: the command is below the verb, whose flags may stand before it too.
    """
    default = argparse.SUPPRESS if nested else None
    parser.add_argument(
        "--rounds", type=count, default=default, metavar="N", help=f"turns of each ({rounds})"
    )
    parser.add_argument(
        "--json",
        type=_writable,
        default=default,
        metavar="FILE",
        help="write the figures there too",
    )


def write_rows(file: Path | None, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a table's rows to the file of `--json`, if there is one."""
    if file is not None:
        replace_file(file, json.dumps(rows, indent=2).encode() + b"\n")


def _writable(text: str) -> Path:
    """Return a file's path; refused before minutes of measuring are lost to it."""
    file = Path(text)
    if file.is_dir() or not file.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text[:200]!r}: name a file in a folder that exists")
    return file
