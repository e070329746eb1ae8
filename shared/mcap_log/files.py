"""Names and locks of a run's files.

A run is `run.mcap`, `run_1.mcap`, `run_2.mcap`, ...; the next run in the same directory is
`run-1.mcap`, `run-1_1.mcap`, .... The recovered copy of a damaged file is `run.recovered.mcap`. A
recorder locks its file while it writes, and the kernel releases the lock when the recorder dies. An
unfinished file without a lock is to be recovered.
"""

from __future__ import annotations

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

SUFFIX: Final = ".mcap"
FIRST: Final = "run" + SUFFIX
RECOVERED: Final = ".recovered" + SUFFIX


def free_stem(directory: Path) -> str:
    """Return the first of run, run-1, ... without a file: no file is ever replaced."""
    stem = first = FIRST.removesuffix(SUFFIX)
    number = 0
    while any(directory.glob(f"{stem}.*mcap")) or any(directory.glob(f"{stem}_*{SUFFIX}")):
        number += 1
        stem = f"{first}-{number}"
    return stem


def create(directory: Path, stem: str, number: int) -> tuple[Path, BinaryIO]:
    """Create and lock a run's file of some number, from 0.

    Raises:
        OSError: it cannot be created, or exists.
    """
    path = directory / (f"{stem}_{number}{SUFFIX}" if number else f"{stem}{SUFFIX}")
    file = path.open("xb")
    with contextlib.suppress(OSError):  # a file system without locks
        fcntl.flock(file, fcntl.LOCK_EX)  # waits for nobody but who just looks whether it is free
    return path, file


def recovered_name(path: Path) -> Path:
    """Return where a recovered file goes by default: `run.recovered.mcap` beside it."""
    return path.with_name(path.name.removesuffix(SUFFIX) + RECOVERED)


def in_use(path: Path) -> bool:
    """Return True if a recorder that lives is writing a file.

    Raises:
        OSError: it cannot be opened.
    """
    with locked(path) as acquired:
        return not acquired


@contextlib.contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold the lock of a file; False if somebody else has it.

    Raises:
        OSError: it cannot be opened.
    """
    with path.open("rb") as file:
        free = True
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            free = False
        except OSError:  # a file system without locks
            free = True
        yield free
