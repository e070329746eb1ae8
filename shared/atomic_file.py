"""Atomic writes, used for all results: a file exists whole or not at all."""

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
    """Yield a new file beside `path`, which replaces `path` if the block succeeds.

    Otherwise the new file is removed, and the old one stays. A kill leaves `.NAME.part`, which the
    next attempt replaces. `private`: only this user has access; `exclusive`: refuse to replace a
    file; `lasting`: return only when the file is on the disk. Raises OSError, with `path` as its
    `filename`.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        _refuse_existing(path, exclusive=exclusive)
        part.unlink(missing_ok=True)  # left by an earlier attempt, perhaps with wrong permissions
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
    """Write a file whole or not at all, as `atomic_file` does."""
    with atomic_file(path, private=private) as file:
        file.write(content)


def _refuse_existing(path: Path, *, exclusive: bool) -> None:
    if exclusive and os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def _sync_directory(directory: Path) -> None:
    """Sync the directory, which contains the file's new name, to the disk."""
    with contextlib.suppress(OSError):  # not every file system supports this
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
