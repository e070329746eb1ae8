"""Which files belong to one run: a split run is several, in one directory."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

from shared.exceptions import RunError
from shared.mcap_log.files import SUFFIX
from shared.mcap_log.reader import open_log
from shared.mcap_log.records import Metadata

MetadataByName = dict[str, dict[str, str]]


def head_of(path: Path) -> MetadataByName:
    """Return the metadata at the start of a file, up to its first messages."""
    found: MetadataByName = {}
    with open_log(path) as reader:
        for record in reader:
            if record.rows:
                break
            if isinstance(record.value, Metadata):
                found[record.value.name] = record.value.metadata
    return found


def files_of_run(path: Path, metadata: MetadataByName) -> list[Path]:
    """Return the files of the run that one of them belongs to, in order; that one at least.

    A recovered copy stands in for nothing: only if the original is gone it is taken.
    """
    run = metadata.get("split", {}).get("run")
    if not run:
        return [path]
    numbers = {path: _number(metadata)}
    for other in _names(path.parent):
        if other.resolve() == path.resolve():
            continue
        with contextlib.suppress(RunError):
            head = head_of(other)
            number = _number(head)
            if head.get("split", {}).get("run") == run and number not in numbers.values():
                numbers[other] = number
    return sorted(numbers, key=lambda file: numbers[file])


def further_files(path: Path) -> list[Path]:
    """Return the other files of the run that a file belongs to."""
    own = path.resolve()
    return [file for file in files_of_run(path, head_of(path)) if file.resolve() != own]


def files_in(directory: Path) -> list[Path]:
    """Return the files of the one run in a directory, in order."""
    runs = runs_in(directory)
    if len(runs) > 1:
        first = ", ".join(run[0].name for run in runs)
        raise RunError(f"{directory}: holds {len(runs)} runs ({first}); give the files of one")
    return runs[0]


def runs_in(directory: Path) -> list[list[Path]]:
    """Return the files of each run in a directory: a recorder that restarts begins one."""
    names = sorted(directory.glob(f"*{SUFFIX}"), key=lambda file: (len(file.name), file.name))
    plain = [path for path in names if "." not in path.stem]  # not recovered or executed again
    runs: list[list[Path]] = []
    unreadable: RunError | None = None
    for path in plain or names:
        if any(path in run for run in runs):
            continue
        try:
            runs.append(files_of_run(path, head_of(path)))
        except RunError as error:
            unreadable = error
    if not runs:
        raise unreadable or RunError(f"{directory}: holds no {SUFFIX} file; give a run's directory")
    return runs


def _names(directory: Path) -> Iterable[Path]:
    return sorted(directory.glob(f"*{SUFFIX}"), key=lambda path: (len(path.name), path.name))


def _number(metadata: MetadataByName) -> int:
    text = metadata.get("split", {}).get("number", "")
    return int(text) if text.isdecimal() and text.isascii() and len(text) < 10 else 0
