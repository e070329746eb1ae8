"""Files that exist whole or not at all, however their writer ends; all results are written so."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def atomic_file(
    path: Path, *, private: bool = False, exclusive: bool = False, lasting: bool = False
) -> Iterator[BinaryIO]:
    """Yield a file beside a path; it replaces the path when the block succeeds.

    Otherwise it is removed and the old file stays. A kill leaves `.NAME.part`, which the next try
    replaces. `private`: for this user alone; `exclusive`: replace no file; `lasting`: return when
    it is on the disk. Raises OSError, whose `filename` is the path, if it cannot be written or
    exists.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        _refuse_existing(path, exclusive=exclusive)
        part.unlink(missing_ok=True)  # of an earlier try, with whatever rights
        mode = 0o600 if private else 0o666
        with os.fdopen(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            yield file
            file.flush()
            if lasting:
                os.fsync(file.fileno())
        _refuse_existing(path, exclusive=exclusive)
        part.replace(path)
        if lasting:
            _sync_directory(path.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(part)):
            error.filename = str(path)
        raise


def replace_file(path: Path, content: bytes, *, private: bool = False) -> None:
    """Write a file whole or not at all, as `atomic_file`."""
    with atomic_file(path, private=private) as file:
        file.write(content)


def _refuse_existing(path: Path, *, exclusive: bool) -> None:
    if exclusive and os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def _sync_directory(directory: Path) -> None:
    """Write the new name to the disk: the directory holds it, not the file."""
    with contextlib.suppress(OSError):  # not every file system can
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
