"""The run directory of a fleet, with its logs, and the live directory, with its sockets and memory.

The run directory names the fleet and may be on a disk. Everything that a restart creates, removes
or opens for writing is in the live directory (`live_dir`), in memory: a service must come back
after the disk has turned read-only.

The names of both can be guessed, and both may be in a folder where everybody may write. So a
directory that belongs to another user, or that others may write to, is refused wherever it is
named.
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
"""Environment variable that names the run directory of the fleet."""


FLEET_VARIABLE: Final = "XRL_FLEET"
"""Environment variable of every process that a fleet's supervisor starts: its run directory."""

_MEMORY_FOLDERS: Final = (Path("/run/lock"), Path("/dev/shm"))  # noqa: S108 - owners are checked
"""Folders for the live directories, best first. At logout systemd may remove a user's files from
/dev/shm (logind.conf: RemoveIPC), but not from /run/lock."""
_MEMORY_TYPES: Final = ("tmpfs", "ramfs")


def default_run_dir() -> Path:
    """Return the run directory: sockets, logs and the supervisor's files of one fleet."""
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

    Decides by type and mode, not by what this process may write: a systemd unit and a shell must
    find the same folder.
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
    """Return the live directory of a run directory, made for this user alone if it is missing."""
    path = live_dir(run_dir)
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    return path


def check_own(path: Path, *, alone: bool = True) -> None:
    """Refuse a run directory that is not this user's, or whose live directory is not.

    A missing directory is accepted. `alone`: also refuse a directory if others may write to it or
    to one above it. A fleet is not started or acted on there. It can be stopped, because the rights
    may have changed while it was up. Raises FleetError.
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
        raise FleetError(f"{path}: cannot be used as a run directory: {error.strerror}") from None
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

    As sshd's StrictModes: each directory above belongs to this user or root. If others may write to
    it, only the owner of an entry may rename that entry (the sticky bit, as /tmp has it).
    """
    for above in dict.fromkeys((*path.absolute().parents, *path.resolve().parents)):
        try:
            found = above.stat()
        except FileNotFoundError:
            continue  # it is made for this user alone
        if found.st_uid not in (0, os.getuid()):
            wrong = f"{above} belongs to another user, who can replace it"
        elif _others_may_rename_in(found):
            remedy = f"run `chmod go-w {shlex.quote(str(above))}`"
            wrong = f"other users can write to {above} and replace it; {remedy}"
        else:
            continue
        raise FleetError(f"{path}: {wrong}; or give another --run-dir")


def _others_may_rename_in(directory: os.stat_result) -> bool:
    if directory.st_mode & stat.S_ISVTX:
        return False
    by_group = directory.st_mode & stat.S_IWGRP and not _is_own_group(directory.st_gid)
    return bool(directory.st_mode & stat.S_IWOTH or by_group)


def _is_own_group(gid: int) -> bool:
    """Return True for the group that many systems make for each user, without other members."""
    try:
        group, user = grp.getgrgid(gid), pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return False
    return group.gr_name == user and set(group.gr_mem) <= {user}


def open_private(path: Path) -> BinaryIO:
    """Open or create a file to read and write, for this user alone, whatever the umask.

    If others had access to it, they lose it. Raises OSError if it is a link or another user's.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, PRIVATE)
    os.fchmod(descriptor, PRIVATE)
    return os.fdopen(descriptor, "r+b")


def mapped(path: Path, size: int) -> mmap.mmap:
    """Return a shared file as memory; create it and its directory if missing, for this user alone.

    Its space is allocated now: on a full disk the first store would end the process (SIGBUS).

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
    """Make files that are created meanwhile private to this user, whatever the umask."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)


def service_directory(text: str) -> Path:
    """Return the run directory of a service, checked if it was started by hand.

    Under a supervisor it was checked when the fleet started. A service that replaces a crashed one
    starts whatever the directory has become, because its module must be held. Raises
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
