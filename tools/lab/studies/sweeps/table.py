"""A study's table: one CSV row per case, in order; an interrupted study resumes.

Each new row rewrites the whole file. Beside it, `inputs.json` contains the study's parameters. A
folder with other parameters is refused, and so is one to which another study is writing.
"""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

import msgspec

from shared.atomic_file import atomic_file
from shared.exceptions import RunError

INPUTS_FILE: Final = "inputs.json"
DECIMALS: Final = 9
"""Maximum number of decimals of a flag's value."""
Row: TypeAlias = Mapping[str, Any]
"""A case's draws as drawn, then its figures as in the table."""


class CaseTable:
    """The open table, a context manager."""

    def __init__(
        self,
        path: Path,
        drawn: Sequence[Mapping[str, object]],
        figures: type[msgspec.Struct],
        inputs: Mapping[str, str],
    ) -> None:
        """Open a new table, or one to resume.

        A row begins with the draws of its case, the case's number first, and ends with its
        figures. `inputs` are parameters of all rows, by name.

        Raises:
            RunError: the folder cannot be used, another study is writing to it, its parameters
                differ or are unknown, or the table is damaged.
        """
        folder = path.parent
        self._path, self._figures = path, figures
        self._columns = [*drawn[0], *figures.__struct_fields__]
        self._drawn = {int(str(case[self._columns[0]])): case for case in drawn}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._inputs = (folder / INPUTS_FILE).open("a+", encoding="utf-8", errors="replace")
            try:
                self._claim(inputs)
                self._rows = self._read()
            except BaseException:
                self._inputs.close()  # which also unlocks it
                raise
        except OSError as error:
            raise RunError(f"{folder}: {error.strerror}; choose another --out") from None

    def __enter__(self) -> CaseTable:
        """Return the table."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the inputs' file, so that another study can write to the folder."""
        self._inputs.close()

    @property
    def numbers(self) -> set[int]:
        """The finished cases, including those that this call did not request."""
        return set(self._rows)

    @property
    def rows(self) -> list[Row]:
        """The finished rows of the requested cases, in order."""
        return [self._typed(row) for number, row in sorted(self._rows.items())
                if number in self._drawn]  # fmt: skip

    def add(self, case: Mapping[str, object], figures: msgspec.Struct) -> Row:
        """Write a row and return it; None is written as an empty cell."""
        values = {**case, **msgspec.structs.asdict(figures)}
        row = {name: _text(value) for name, value in values.items()}
        self._rows[int(row[self._columns[0]])] = row
        with atomic_file(self._path, lasting=True) as raw:
            file = io.TextIOWrapper(raw, encoding="utf-8", newline="", write_through=True)
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(known for _, known in sorted(self._rows.items()))
            file.detach()
        return self._typed(row)

    def _typed(self, row: Mapping[str, str]) -> Row:
        """Return a row as values; raise `msgspec.ValidationError` if it is damaged."""
        texts = {name: row[name] or None for name in self._figures.__struct_fields__}
        figures = msgspec.convert(texts, self._figures, strict=False)
        drawn = self._drawn.get(int(row[self._columns[0]]), row)
        return {**drawn, **msgspec.structs.asdict(figures)}

    def _claim(self, inputs: Mapping[str, str]) -> None:
        """Lock the inputs' file; write the inputs into it, or compare them with its content."""
        folder, file = self._path.parent, self._inputs
        others = {one.name for one in folder.iterdir()} - {INPUTS_FILE}
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(
                f"{folder}: another study is writing to it; choose another --out"
            ) from None
        file.seek(0)
        text = file.read()
        if not text and not others:
            file.write(json.dumps(dict(inputs), indent=2) + "\n")
            file.flush()
            os.fsync(file.fileno())
            return
        try:
            there = msgspec.json.decode(text, type=dict[str, str])
        except msgspec.DecodeError:
            if not text:
                (folder / INPUTS_FILE).unlink()
            raise RunError(
                f"{folder}: contains files that are not a study's, or a damaged {INPUTS_FILE}; "
                "choose another --out"
            ) from None
        for name, value in inputs.items():
            if there.get(name) != value:
                raise RunError(
                    f"{folder}: contains a study with different parameters ({name} "
                    f"{str(there.get(name))[:20]}, now {value[:20]}); choose another --out"
                )

    def _read(self) -> dict[int, dict[str, str]]:
        if not self._path.exists():
            return {}
        with self._path.open(encoding="utf-8", newline="") as file:
            table = csv.DictReader(file)
            try:
                if table.fieldnames != self._columns:
                    raise RunError(
                        f"{self._path}: its columns are not this study's; choose another --out"
                    )
                rows = {int(row[self._columns[0]]): row for row in table}
                for row in rows.values():
                    self._typed(row)
            except (ValueError, TypeError):
                raise RunError(f"{self._path}: is damaged; choose another --out") from None
        return rows


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def plain(value: float) -> str:
    """Return a number as text, with up to 9 decimals and without an exponent."""
    return f"{value:.{DECIMALS}f}".rstrip("0").rstrip(".")
