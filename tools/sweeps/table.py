"""A study's table: one CSV row a case, written as it is done, gone on with after a stop.

Beside the table, `inputs.json` says what it was made from; a folder of other inputs is
refused. A finished table is sorted by case: the same inputs give the same file.
"""

from __future__ import annotations

import ast
import csv
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final

from shared.exceptions import RunError

INPUTS_FILE: Final = "inputs.json"
ROOT: Final = Path(__file__).resolve().parents[2]
Row = Mapping[str, str]


def code_of(*modules: str) -> tuple[str, ...]:
    """Return all of our code that some modules of the tools run: the parts for `code_digest`.

    Args:
        modules: by name, such as `tools.runs.lockstep`.

    Returns:
        Services and shared, and of the tools the files of these modules and of all that they
        import, and so on.
    """
    todo, files = list(modules), set[str]()
    while todo:
        name = todo.pop()
        file = f"{name.replace('.', '/')}.py"
        if file in files or not name.startswith("tools.") or not (ROOT / file).is_file():
            continue
        files.add(file)
        for node in ast.walk(ast.parse((ROOT / file).read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                todo += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return ("services", "shared", *sorted(files))


def code_digest(parts: Sequence[str]) -> str:
    """Return the SHA-256 of Python files, named as files or folders from the root on."""
    digest = hashlib.sha256()
    for part in parts:
        place = ROOT / part
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


class Table:
    """The open table; use it as a context."""

    def __init__(
        self, folder: Path, name: str, columns: Sequence[str], inputs: Mapping[str, str]
    ) -> None:
        """Open or go on with a table; its first column is the case's number.

        Args:
            folder: of the results; made if it is not there.
            name: of the CSV file.
            columns: of the table.
            inputs: what the rows depend on, by name.

        Raises:
            RunError: the folder cannot be used, or was made from other inputs.
        """
        self._path, self._columns = folder / name, tuple(columns)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _claim(folder / INPUTS_FILE, inputs)
            self._rows = _whole_rows(self._path, self._columns)
            self._write()  # a row cut off by a power failure is out
            self._file = self._path.open("a", encoding="utf-8", newline="")
        except OSError as error:
            raise RunError(f"{folder}: {error.strerror}; choose another --out") from None

    def __enter__(self) -> Table:
        """Return the table."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Sort the rows and close the file; however the study ended."""
        self._file.close()
        self._write()

    @property
    def numbers(self) -> set[int]:
        """The cases that are done."""
        return set(self._rows)

    def rows(self, below: int) -> list[Row]:
        """Return the rows of the cases with a number below this one, in order."""
        return [row for number, row in sorted(self._rows.items()) if number < below]

    def add(self, values: Mapping[str, object]) -> None:
        """Write a row; a value that is None is left empty."""
        row = {name: _text(values[name]) for name in self._columns}
        self._rows[int(row[self._columns[0]])] = row
        csv.DictWriter(self._file, self._columns).writerow(row)
        self._file.flush()

    def _write(self) -> None:
        """Write all rows anew; the file is whole or the old one."""
        temporary = self._path.with_suffix(".tmp")
        with temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(row for _, row in sorted(self._rows.items()))
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self._path)


def _claim(path: Path, inputs: Mapping[str, str]) -> None:
    """Write the inputs, or compare them with those that are there.

    Raises:
        RunError: they differ.
    """
    try:
        there = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        path.write_text(json.dumps(dict(inputs), indent=2) + "\n", encoding="utf-8")
        return
    except ValueError:
        raise RunError(f"{path}: cannot be read; choose another --out") from None
    for name, value in inputs.items():
        if there.get(name) != value:
            raise RunError(
                f"{path.parent}: holds a study of another {name} "
                f"({_short(there.get(name))}, now {_short(value)}); choose another --out"
            )


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 20 else f"{text[:8]}..."


def _whole_rows(path: Path, columns: Sequence[str]) -> dict[int, Row]:
    """Read the rows that are whole."""
    if not path.exists():
        return {}
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]  # what has no end is not whole
    rows = csv.DictReader(lines)
    if tuple(rows.fieldnames or ()) != tuple(columns):
        raise RunError(f"{path}: has other columns; choose another --out")
    return {int(row[columns[0]]): row for row in rows if None not in (*row, *row.values())}


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
