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
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import IO, Final, TypeAlias

from shared.atomic_file import atomic_file
from shared.exceptions import RunError
from shared.places import CHECKOUT

INPUTS_FILE: Final = "inputs.json"
Row: TypeAlias = Mapping[str, str]
Words: TypeAlias = Mapping[str, Set[str]]
"""The columns that hold words, and all that each may hold."""
NO_WORDS: Final[Words] = MappingProxyType({})


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
        folder: Path,
        name: str,
        columns: Sequence[str],
        inputs: Mapping[str, str],
        words: Words = NO_WORDS,
        drawn: Iterable[Mapping[str, object]] = (),
    ) -> None:
        """Open a table, new or to resume; its first column is the case's number.

        Incomplete or damaged rows are left out: their cases are run again.

        Args:
            folder: of the results; made if it is not there.
            name: of the CSV file.
            columns: of the table.
            inputs: parameters of the rows, by name.
            words: columns that hold words, and which.
            drawn: by case, the start of its row.

        Raises:
            RunError: the folder cannot be used, another study is writing to it, or its parameters
                are others or unknown.
        """
        self._path, self._columns = folder / name, tuple(columns)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _refuse_foreign(folder, self._path)
            self._inputs = (folder / INPUTS_FILE).open("a+", encoding="utf-8")
        except OSError as error:
            raise _unusable(folder, error) from None
        try:
            _claim(self._inputs, self._path, inputs)
            self._rows = _whole_rows(self._path, self._columns, words)
            for case in drawn:
                self._check({name: _text(value) for name, value in case.items()})
            self._write()
            self._file = self._path.open("a", encoding="utf-8", newline="")
        except BaseException as error:
            self._inputs.close()  # and no longer locked
            if isinstance(error, OSError):
                raise _unusable(folder, error) from None
            raise

    def __enter__(self) -> CaseTable:
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
        self._inputs.close()

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

    def _check(self, case: Row) -> None:
        """Leave out the row of a case if it is of another one."""
        number = int(case[self._columns[0]])
        there = self._rows.get(number, case)
        if any(there[name] != value for name, value in case.items()):
            del self._rows[number]

    def _write(self) -> None:
        """Rewrite all rows atomically."""
        with atomic_file(self._path, lasting=True) as raw:
            file = io.TextIOWrapper(raw, encoding="utf-8", newline="", write_through=True)
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(row for _, row in sorted(self._rows.items()))
            file.detach()


def _refuse_foreign(folder: Path, table: Path) -> None:
    """Refuse a folder that holds something, and no study.

    Raises:
        RunError: it does.
    """
    if any(folder.iterdir()) and not (folder / INPUTS_FILE).exists() and not table.exists():
        raise RunError(f"{folder}: holds other files than a study's; choose another --out")


def _unusable(folder: Path, error: OSError) -> RunError:
    return RunError(f"{folder}: {error.strerror}; choose another --out")


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


def _whole_rows(path: Path, columns: Sequence[str], words: Words) -> dict[int, Row]:
    """Read the rows that are whole, by number.

    Raises:
        RunError: the file has other columns.
    """
    if not path.exists():
        return {}
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    lines = map(_cells, text.split("\n")[:-1])  # a line without an end is incomplete
    if next(lines, list(columns)) != list(columns):
        raise RunError(f"{path}: has other columns; choose another --out")
    return {int(row[columns[0]]): row for row in _whole(lines, columns, words)}


def _whole(lines: Iterator[list[str]], columns: Sequence[str], words: Words) -> Iterator[Row]:
    for cells in lines:
        row = dict(zip(columns, cells, strict=False))
        if (
            len(cells) == len(columns)
            and cells[0].isdecimal()
            and all(
                value in words[name] if name in words else _is_number(value)
                for name, value in row.items()
            )
        ):
            yield row


def _cells(line: str) -> list[str]:
    """Return the cells of a line; none if it is malformed."""
    try:
        return next(csv.reader([line], strict=True), [])
    except csv.Error:
        return []


def _is_number(value: str) -> bool:
    """Return True for a number, and for none."""
    try:
        float(value or "0")
    except ValueError:
        return False
    return True


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
