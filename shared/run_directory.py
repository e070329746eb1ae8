"""The run directory of a fleet, with its logs, and the live directory, with its sockets and memory.

The run directory identifies the fleet and may be on a disk. Everything that a restart creates,
removes or opens for writing is in the live directory (`live_dir`), in memory, so that a service can
restart after the disk has become read-only.

Both names can be guessed, and both directories may be in a world-writable folder. So a directory
that belongs to another user, or that others may write to, is refused.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import functools
import grp
import hashlib
import mmap
import os
import pwd
import shlex
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Final

from shared.exceptions import FleetError, os_error_in_words

PRIVATE: Final = stat.S_IRUSR | stat.S_IWUSR

RUN_DIR_VARIABLE = "XRL_RUN_DIR"
"""Environment variable with the default run directory."""


FLEET_VARIABLE: Final = "XRL_FLEET"
"""Environment variable that the supervisor sets for its processes: the run directory."""

_MEMORY_FOLDERS: Final = (Path("/run/lock"), Path("/dev/shm"))  # noqa: S108 - owners are checked
"""Folders for the live directories, best first. At logout systemd may remove a user's files from
/dev/shm (logind.conf: RemoveIPC), but not from /run/lock."""
_MEMORY_TYPES: Final = ("tmpfs", "ramfs")


def default_run_dir() -> Path:
    """Return the default run directory, for logs and the supervisor's files of one fleet."""
    return Path(os.environ.get(RUN_DIR_VARIABLE) or f"/tmp/xrl-{os.getuid()}")  # noqa: S108 - short on purpose: socket paths have 107 bytes


def live_dir(run_dir: Path) -> Path:
    """Return the directory of a fleet's sockets and shared memory, by its run directory.

    The name is a hash of the run directory's path, so each process finds it without the disk. On a
    host without a suitable folder in memory it is the run directory itself.
    """
    folder = _memory_folder(_MEMORY_FOLDERS)
    if folder is None:
        return run_dir
    name = hashlib.sha256(os.fsencode(os.path.realpath(run_dir))).hexdigest()[:16]
    return folder / f"xrl-{name}"


@functools.cache
def _memory_folder(folders: tuple[Path, ...]) -> Path | None:
    """Return the first folder that is in memory and where every user may write, or None.

    The folder's type and mode decide, not the permissions of this process, because a systemd unit
    and a shell must find the same folder.
    """
    mounts = [line.split() for line in Path("/proc/self/mounts").read_text("utf-8").splitlines()]
    for folder in folders:
        holding = (mount for mount in mounts if folder.is_relative_to(mount[1]))
        kind = max(holding, key=lambda mount: len(mount[1]), default=("", "", ""))[2]
        shared = stat.S_ISVTX | stat.S_IWOTH
        with contextlib.suppress(OSError):
            if kind in _MEMORY_TYPES and folder.stat().st_mode & shared == shared:
                return folder
    return None


def make_live_dir(run_dir: Path) -> Path:
    """Return the live directory of a run directory; create it, for this user only, if missing."""
    path = live_dir(run_dir)
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    return path


def check_own(path: Path, *, alone: bool = True) -> None:
    """Refuse a run directory that is not this user's, or whose live directory is not.

    A missing directory is accepted. `alone`: also refuse a directory if others may write to it or
    to one above it. Starting or changing a fleet requires this stricter check. Stopping one does
    not, because the permissions may have changed while the fleet ran. Raises FleetError.
    """
    for directory in dict.fromkeys((path, live_dir(path))):
        _check_directory(directory, alone=alone)


def _check_directory(path: Path, *, alone: bool) -> None:
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
        if error.errno == errno.EIO:
            return  # the disk has failed; the fleet on it can still be stopped and signalled
        raise FleetError(
            f"{path}: cannot be used as a run directory: {error.strerror}; give another --run-dir"
        ) from None
    if not stat.S_ISDIR(found.st_mode):
        raise FleetError(f"{path}: is not a directory; give another --run-dir")
    _check_owner(path, found.st_uid)
    if alone and found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise FleetError(
            f"{path}: other users can write to it; run `chmod go-w {shlex.quote(str(path))}`, "
            "or give another --run-dir"
        )
    if alone:
        _check_parents(path)


def _check_parents(path: Path) -> None:
    """Refuse a directory that another user could replace by writing to one above it.

    As with sshd's StrictModes, each directory above must belong to this user or root. If others may
    write to it, it must have the sticky bit, as /tmp does: then only an entry's owner may rename
    it.
    """
    for above in dict.fromkeys((*path.absolute().parents, *path.resolve().parents)):
        try:
            found = above.stat()
        except FileNotFoundError:
            continue  # it will be created for this user only
        if found.st_uid not in (0, os.getuid()):
            wrong = f"{above} belongs to another user, who can replace it"
            remedy = "give another --run-dir"
        elif _others_may_rename_in(found):
            wrong = f"other users can write to {above} and replace it"
            remedy = f"run `chmod go-w {shlex.quote(str(above))}`, or give another --run-dir"
        else:
            continue
        raise FleetError(f"{path}: {wrong}; {remedy}")


def _others_may_rename_in(directory: os.stat_result) -> bool:
    if directory.st_mode & stat.S_ISVTX:
        return False
    by_group = directory.st_mode & stat.S_IWGRP and not _is_own_group(directory.st_gid)
    return bool(directory.st_mode & stat.S_IWOTH or by_group)


def _is_own_group(gid: int) -> bool:
    """Return True for a user's own group, as many systems create it, without other members."""
    try:
        group, user = grp.getgrgid(gid), pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return False
    return group.gr_name == user and set(group.gr_mem) <= {user}


def open_private(path: Path) -> BinaryIO:
    """Open or create a file to read and write, for this user only, regardless of the umask.

    If others had access, they lose it. Raises OSError if the file is a link or belongs to another
    user.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, PRIVATE)
    os.fchmod(descriptor, PRIVATE)
    return os.fdopen(descriptor, "r+b")


def mapped(path: Path, size: int) -> mmap.mmap:
    """Map a shared file into memory; create it and its directory, for this user only, if missing.

    Its space is allocated now, because on a full disk the first store would end the process
    (SIGBUS).

    Raises:
        FleetError: it cannot be created.
    """
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with open_private(path) as file:
            os.posix_fallocate(file.fileno(), 0, size)
            return mmap.mmap(file.fileno(), size)
    except OSError as error:
        words = os_error_in_words(OSError(error.errno, error.strerror))
        raise FleetError(f"{path}: cannot create shared memory: {words}") from None


@contextlib.contextmanager
def private_files() -> Iterator[None]:
    """Make files created in the block private to this user, regardless of the umask."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)


def service_directory(text: str) -> Path:
    """Return the run directory of a service; check it if a person started the service.

    Under a supervisor it was checked when the fleet started. A service that replaces a crashed one
    starts even if the directory has changed since, because its module must be held. Raises
    argparse.ArgumentTypeError if `check_own` refuses it.
    """
    return Path(text) if FLEET_VARIABLE in os.environ else own_directory(text, alone=True)


def own_directory(text: str, *, alone: bool = False) -> Path:
    """Return a run directory named on a command line.

    Raises argparse.ArgumentTypeError if `check_own` refuses it.
    """
    path = Path(text)
    try:
        check_own(path, alone=alone)
    except FleetError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return path


def _check_owner(path: Path, owner: int) -> None:
    if owner != os.getuid():
        raise FleetError(f"{path}: belongs to another user; give another --run-dir")
