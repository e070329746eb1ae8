"""A study through the command line, and the table that it wrote."""

from __future__ import annotations

import csv
from pathlib import Path

from tools import cli


def sweep(*words: object) -> int:
    return cli.main(["study", *map(str, words)])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
