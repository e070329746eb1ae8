"""A study's table: one row per case, appended on completion; an interrupted study resumes.

Beside the table, `inputs.json` holds its parameters; a folder with others is refused, and so is one
that another study is writing to. A finished table is sorted by case: equal inputs give an equal
file.
"""

from __future__ import annotations

import ast
import csv
import fcntl
import hashlib
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final, TypeAlias

import msgspec

from shared.atomic_file import atomic_file
from shared.exceptions import RunError
from shared.places import CHECKOUT

INPUTS_FILE: Final = "inputs.json"
DECIMALS: Final = 9
"""To which a number of a flag is taken."""
Row: TypeAlias = Mapping[str, Any]
"""A case's draws as they were drawn, then its figures as the table has them."""


def code_of(*modules: str) -> tuple[str, ...]:
    """Return all of our code that some modules of the tools run: the parts for `code_digest`.

    Args:
        modules: by name, such as `tools.sim.lockstep`.

    Returns:
        Services and shared, and of the tools the files of these modules and of all that they
        import, and so on.
    """
    todo, files = list(modules), set[str]()
    while todo:
        name = todo.pop()
        file = f"{name.replace('.', '/')}.py"
        if file in files or not name.startswith("tools.") or not (CHECKOUT / file).is_file():
            continue
        files.add(file)
        for node in ast.walk(ast.parse((CHECKOUT / file).read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                todo += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                todo += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return ("services", "shared", *sorted(files))


def code_digest(parts: Sequence[str]) -> str:
    """Return the SHA-256 of Python files, named as files or folders from the root on."""
    digest = hashlib.sha256()
    for part in parts:
        place = CHECKOUT / part
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(path.relative_to(CHECKOUT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


class CaseTable:
    """The open table; use it as a context."""

    def __init__(
        self,
        path: Path,
        drawn: Sequence[Mapping[str, object]],
        figures: type[msgspec.Struct],
        inputs: Mapping[str, str],
    ) -> None:
        """Open a table, new or to resume.

        Incomplete or damaged rows are left out, and those of other draws: their cases run again.

        Args:
            path: of the CSV file; its folder is made if it is not there.
            drawn: by case, the start of its row; the first column is the case's number.
            figures: the rest of a row.
            inputs: parameters of the rows, by name.

        Raises:
            RunError: the folder cannot be used, another study is writing to it, or its parameters
                are others or unknown.
        """
        folder = path.parent
        self._path, self._figures = path, figures
        self._columns = [*drawn[0], *figures.__struct_fields__]
        self._words = {
            field.name
            for field in msgspec.structs.fields(figures)
            if getattr(field.type, "__origin__", field.type) is str
        }
        self._drawn = {str(case[self._columns[0]]): case for case in drawn}
        self._rows: dict[int, dict[str, str]] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()) and not (folder / INPUTS_FILE).exists() and not path.exists():
                raise RunError(f"{folder}: holds other files than a study's; choose another --out")
            self._inputs = (folder / INPUTS_FILE).open("a+", encoding="utf-8")
            try:
                _claim(self._inputs, path, inputs)
                self._read()
                self._write()
                self._file = path.open("a", encoding="utf-8", newline="")
            except BaseException:
                self._inputs.close()  # and no longer locked
                raise
        except OSError as error:
            raise RunError(f"{folder}: {error.strerror}; choose another --out") from None

    def __enter__(self) -> CaseTable:
        """Return the table."""
        return self

    def __exit__(self, *_: object) -> None:
        """Sort the rows and close the file; however the study ended."""
        self._file.close()
        self._write()
        self._inputs.close()

    @property
    def numbers(self) -> set[int]:
        """The cases that are done, also those that are not asked for now."""
        return set(self._rows)

    @property
    def rows(self) -> list[Row]:
        """The rows of the cases that are done, in order."""
        asked = sorted(number for number in self._rows if str(number) in self._drawn)
        return [self._typed(self._rows[number]) for number in asked]

    def add(self, case: Mapping[str, object], figures: msgspec.Struct) -> Row:
        """Write a row and return it; a value that is None is left empty."""
        values = {**case, **msgspec.structs.asdict(figures)}
        row = {name: _text(value) for name, value in values.items()}
        self._rows[int(row[self._columns[0]])] = row
        csv.DictWriter(self._file, self._columns).writerow(row)
        self._file.flush()
        return self._typed(row)

    def _typed(self, row: Mapping[str, str]) -> Row:
        """Return a row with its values; raise `msgspec.ValidationError` if it is damaged."""
        figures = {
            name: row[name] if row[name] or name in self._words else None
            for name in self._figures.__struct_fields__
        }
        typed = msgspec.convert(figures, self._figures, strict=False)
        drawn = self._drawn.get(row[self._columns[0]], row)
        return {**drawn, **msgspec.structs.asdict(typed)}

    def _read(self) -> None:
        """Read the rows that are whole, and of the cases that are drawn.

        Raises:
            RunError: the file has other columns.
        """
        if not self._path.exists():
            return
        text = self._path.read_text(encoding="utf-8-sig", errors="replace")
        lines = map(_cells, text.split("\n")[:-1])  # a line without an end is incomplete
        if next(lines, self._columns) != self._columns:
            raise RunError(f"{self._path}: has other columns; choose another --out")
        for cells in lines:
            if len(cells) == len(self._columns) and cells[0].isdecimal():
                row = dict(zip(self._columns, cells, strict=True))
                case = self._drawn.get(cells[0], {})
                try:
                    self._typed(row)
                except msgspec.ValidationError:
                    continue
                if all(row[name] == _text(value) for name, value in case.items()):
                    self._rows[int(cells[0])] = row

    def _write(self) -> None:
        """Rewrite all rows atomically."""
        with atomic_file(self._path, lasting=True) as raw:
            file = io.TextIOWrapper(raw, encoding="utf-8", newline="", write_through=True)
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(row for _, row in sorted(self._rows.items()))
            file.detach()


def _claim(file: IO[str], table: Path, inputs: Mapping[str, str]) -> None:
    """Lock the inputs' file; write them into it, or compare them with those that are there.

    Raises:
        RunError: it is locked, or they differ.
    """
    folder = table.parent
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RunError(f"{folder}: another study is writing there; choose another --out") from None
    file.seek(0)
    try:
        text = file.read()
        there = json.loads(text) if text else None
    except ValueError:
        text, there = "?", None
    if not text and not table.exists():
        file.write(json.dumps(dict(inputs), indent=2) + "\n")
        file.flush()
        os.fsync(file.fileno())
        return
    if not isinstance(there, dict):
        raise RunError(
            f"{folder}: {INPUTS_FILE} does not say what {table.name} was made from; choose another "
            "--out"
        )
    for name, value in inputs.items():
        if there.get(name) != value:
            raise RunError(
                f"{folder}: holds a study of another {name} "
                f"({_short(there.get(name))}, now {_short(value)}); choose another --out"
            )


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 20 else f"{text[:8]}..."


def _cells(line: str) -> list[str]:
    """Return the cells of a line; none if it is malformed."""
    try:
        return next(csv.reader([line], strict=True), [])
    except csv.Error:
        return []


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def plain(value: float) -> str:
    """Return a number in full, to 9 decimals and without an exponent."""
    return f"{value:.{DECIMALS}f}".rstrip("0").rstrip(".")
