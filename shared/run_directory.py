"""The run directory: one fleet's sockets, memory and logs. Whose it is, is looked at before use.

Its name can be guessed and lies in a folder where everybody may write: a directory that is somebody
else's, or that others may write to, is refused wherever one is named.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from shared.exceptions import FleetError

RUN_DIR_VARIABLE = "XRL_RUN_DIR"
"""Environment variable that names the run directory of the fleet."""


def default_run_dir() -> Path:
    """Return the run directory: sockets, logs and the supervisor's files of one fleet."""
    return Path(os.environ.get(RUN_DIR_VARIABLE) or f"/tmp/xrl-{os.getuid()}")  # noqa: S108 - short on purpose: socket paths have 107 bytes


def check_own(path: Path, *, alone: bool = True) -> None:
    """Refuse a directory that is not this user's; one that is not there is no fault.

    Args:
        path: the directory.
        alone: refuse one that others may write to, too. A fleet is not started or acted on in
            such a one; it can be stopped, for it may have become one while the fleet was up.

    Raises:
        FleetError: it is somebody else's, others may write to it, or it is no directory.
    """
    try:
        found = path.lstat()
        if stat.S_ISLNK(found.st_mode):
            _check_owner(path, found.st_uid)
            found = path.stat()
    except FileNotFoundError:
        return
    except OSError as error:
        raise FleetError(f"{path}: cannot be a run directory: {error.strerror}") from None
    if not stat.S_ISDIR(found.st_mode):
        raise FleetError(f"{path}: is no directory; give another --run-dir")
    _check_owner(path, found.st_uid)
    if alone and found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise FleetError(
            f"{path}: others may write to it; `chmod go-w {path}`, or give another --run-dir"
        )


@contextlib.contextmanager
def private_files() -> Iterator[None]:
    """Make what is created meanwhile this user's alone, whatever the umask: sockets."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)


def own_directory(text: str) -> Path:
    """Return a run directory named on a command line.

    Raises:
        argparse.ArgumentTypeError: it is somebody else's.
    """
    path = Path(text)
    try:
        check_own(path, alone=False)
    except FleetError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return path


def _check_owner(path: Path, owner: int) -> None:
    if owner != os.getuid():
        raise FleetError(f"{path}: belongs to another user; give another --run-dir")
