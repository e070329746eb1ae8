"""Flags that every command of `xrl bench` has, and the file that `--json` names."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from shared.atomic_file import replace_file
from shared.exceptions import FAULT_EXIT_CODE
from tools.flags import Arg, ConfigFlags, Count, Flags, parsed


def _writable(text: str) -> Path:
    """Return a file's path; refused before minutes of measuring are lost to it."""
    file = Path(text)
    if file.is_dir() or not file.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text[:200]!r}: name a file in a folder that exists")
    return file


class BenchFlags(Flags):
    """How often, and where the figures go."""

    rounds: Annotated[Count | None, Arg(metavar="N")] = None
    """turns of each (default: 9 for the parts, 3 else)"""
    json: Annotated[Path | None, parsed(_writable, "FILE")] = None
    """write the figures there too"""


class AgainstFlags(BenchFlags, ConfigFlags):
    """A tree, and one to compare it with."""

    against: Annotated[str | None, Arg(metavar="REV")] = None
    """measure a git revision too, in turn with this tree, and print the ratios; both run in this
    environment"""
    strict: Annotated[bool, Arg(help=f"exit code {FAULT_EXIT_CODE} if a target is missed")] = False


def write_rows(file: Path | None, rows: Sequence[Mapping[str, object]]) -> None:
    """Write a table's rows to the file of `--json`, if there is one."""
    if file is not None:
        replace_file(file, json.dumps(rows, indent=2).encode() + b"\n")
