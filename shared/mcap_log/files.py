"""Names and locks of a run's files, and their sync to the disk.

A run is `run.mcap`, `run_1.mcap`, `run_2.mcap`, ...; the next run in the same directory is
`run-1.mcap`, `run-1_1.mcap`, .... The recovered copy of a damaged file is `run.recovered.mcap`. A
recorder locks its file while it writes, and the kernel releases the lock when the recorder dies. An
unfinished file without a lock can be recovered.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

SUFFIX: Final = ".mcap"
FIRST: Final = "run" + SUFFIX
RECOVERED: Final = ".recovered" + SUFFIX


def free_stem(directory: Path) -> str:
    """Return the first of run, run-1, ... without a file, so that no file is replaced."""
    stem = first = FIRST.removesuffix(SUFFIX)
    number = 0
    while any(directory.glob(f"{stem}.*mcap")) or any(directory.glob(f"{stem}_*{SUFFIX}")):
        number += 1
        stem = f"{first}-{number}"
    return stem


def create(directory: Path, stem: str, number: int) -> tuple[Path, BinaryIO]:
    """Create and lock file `number` (from 0) of a run; raise OSError if it cannot be created."""
    path = directory / (f"{stem}_{number}{SUFFIX}" if number else f"{stem}{SUFFIX}")
    file = path.open("xb")
    with contextlib.suppress(OSError):  # a file system without locks
        fcntl.flock(file, fcntl.LOCK_EX)  # waits only for a process that checks the lock
    return path, file


def recovered_name(path: Path) -> Path:
    """Return the default path of a recovered file: `run.recovered.mcap` beside it."""
    return path.with_name(path.name.removesuffix(SUFFIX) + RECOVERED)


def in_use(path: Path) -> bool:
    """Return True if a live recorder is writing a file; False also if the file cannot be opened."""
    try:
        with locked(path) as acquired:
            return not acquired
    except OSError:
        return False


@contextlib.contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold the lock of a file and yield True; yield False if another process has the lock.

    Raises OSError if the file cannot be opened.
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


class FsyncThread:
    """Thread that syncs files to the disk; the first request starts it.

    A disk under load answers an fsync late: 0.1 s was measured on a machine with four busy
    processes, and memory cards take seconds. In the recorder's loop this wait would make
    the messages' reception times late.
    """

    def __init__(self) -> None:
        self._thread: threading.Thread | None = None
        self._wake = threading.Condition()
        self._waiting: list[int] = []
        """Duplicated descriptors, so that their files may be closed before the sync."""
        self._busy = False
        self._closed = False
        self._error: OSError | None = None

    def request(self, descriptor: int, *, last: bool = False) -> None:
        """Request the sync of a file and return at once; the file may then be closed.

        Unless it is the `last` of this file, a request is skipped while another one waits. Raises
        OSError if an earlier sync failed: written data may not be on the disk.
        """
        with self._wake:
            self._raise()
            if self._waiting and not last:
                return
            self._waiting.append(os.dup(descriptor))
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="fsync", daemon=True)
                self._thread.start()
            self._wake.notify_all()

    def settle(self) -> None:
        """Wait until nothing is left to sync; raise OSError if a sync failed."""
        with self._wake:
            self._wake.wait_for(lambda: not self._waiting and not self._busy)
            self._raise()

    def close(self) -> None:
        """Finish the requested syncs and end the thread; never raises."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                descriptor = self._waiting.pop(0)
                self._busy = True
            error = None
            try:
                os.fsync(descriptor)
            except OSError as failed:
                error = failed
            finally:
                os.close(descriptor)
            with self._wake:
                self._busy = False
                self._error = self._error or error
                self._wake.notify_all()
