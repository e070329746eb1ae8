"""The run directory: one fleet's sockets, memory and logs. Whose it is, is looked at before use.

Its name can be guessed and lies in a folder where everybody may write: a directory that is somebody
else's, or that others may write to, is refused wherever one is named.
"""

from __future__ import annotations

import argparse
import contextlib
import grp
import mmap
import os
import pwd
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from shared.exceptions import FleetError

PRIVATE: Final = stat.S_IRUSR | stat.S_IWUSR

RUN_DIR_VARIABLE = "XRL_RUN_DIR"
"""Environment variable that names the run directory of the fleet."""


FLEET_VARIABLE: Final = "XRL_FLEET"
"""Environment variable of every process that a fleet's supervisor starts: its run directory."""


def default_run_dir() -> Path:
    """Return the run directory: sockets, logs and the supervisor's files of one fleet."""
    return Path(os.environ.get(RUN_DIR_VARIABLE) or f"/tmp/xrl-{os.getuid()}")  # noqa: S108 - short on purpose: socket paths have 107 bytes


def check_own(path: Path, *, alone: bool = True) -> None:
    """Refuse a directory that is not this user's; one that is not there is no fault.

    `alone`: refuse one that others may write to, too, itself or a directory above it. A fleet is
    not started or acted on in such a one; it can be stopped, for it may have become one while the
    fleet was up. Raises FleetError.
    """
    try:
        found = path.lstat()
        if stat.S_ISLNK(found.st_mode):
            _check_owner(path, found.st_uid)
            found = path.stat()
    except FileNotFoundError:
        if alone:
            _check_parents(path)
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
    if alone:
        _check_parents(path)


def _check_parents(path: Path) -> None:
    """Refuse a directory that another user could replace: who may write to one above it can.

    As sshd's StrictModes: each is this user's or root's, and if others may write to it, only the
    owner of an entry may rename that (the sticky bit, as /tmp has it).
    """
    for above in dict.fromkeys((*path.absolute().parents, *path.resolve().parents)):
        try:
            found = above.stat()
        except FileNotFoundError:
            continue  # it is made for this user alone
        if found.st_uid not in (0, os.getuid()):
            wrong = f"{above} belongs to another user, who can replace it"
        elif _others_may_rename_in(found):
            wrong = f"others may write to {above} and replace it; `chmod go-w {above}`"
        else:
            continue
        raise FleetError(f"{path}: {wrong}; or give another --run-dir")


def _others_may_rename_in(directory: os.stat_result) -> bool:
    if directory.st_mode & stat.S_ISVTX:
        return False
    by_group = directory.st_mode & stat.S_IWGRP and not _is_own_group(directory.st_gid)
    return bool(directory.st_mode & stat.S_IWOTH or by_group)


def _is_own_group(gid: int) -> bool:
    """Return True for the group that many systems make for each user, with nobody else in it."""
    try:
        group, user = grp.getgrgid(gid), pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return False
    return group.gr_name == user and set(group.gr_mem) <= {user}


def open_private(path: Path) -> BinaryIO:
    """Open a file of this user alone to read and write, or make it, whatever the umask.

    One that others could read or write, left by an older version, is taken from them. Raises
    OSError if it is a link or somebody else's.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, PRIVATE)
    os.fchmod(descriptor, PRIVATE)
    return os.fdopen(descriptor, "r+b")


def mapped(path: Path, size: int) -> mmap.mmap:
    """Return a shared file as memory, made if it is not there, for this user alone.

    Its space is allocated now: on a full disk the first store would end the process (SIGBUS).

    Raises:
        FleetError: it cannot be made.
    """
    try:
        with open_private(path) as file:
            os.posix_fallocate(file.fileno(), 0, size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        raise FleetError(f"{path}: no shared memory: {error.strerror}") from None


@contextlib.contextmanager
def private_files() -> Iterator[None]:
    """Make what is created meanwhile this user's alone, whatever the umask."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)


def service_directory(text: str) -> Path:
    """Return the run directory of a service, which somebody may have started by hand.

    Under a supervisor it was looked at when the fleet started; a successor of a service that
    crashed begins whatever has become of it, because its module is to be held. Raises
    argparse.ArgumentTypeError as `check_own`.
    """
    return Path(text) if FLEET_VARIABLE in os.environ else own_directory(text, alone=True)


def own_directory(text: str, *, alone: bool = False) -> Path:
    """Return a run directory named on a command line; ArgumentTypeError where `check_own` fails."""
    path = Path(text)
    try:
        check_own(path, alone=alone)
    except FleetError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return path


def _check_owner(path: Path, owner: int) -> None:
    if owner != os.getuid():
        raise FleetError(f"{path}: belongs to another user; give another --run-dir")
