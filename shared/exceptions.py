"""Exceptions of this project.

Exceptions are for start-up, tools and files. On the control path a fault is a state and an event
(docs/architecture.md#age-rule), never an exception.
"""

from __future__ import annotations

import errno
import os
import signal
from typing import Final


class XrlError(Exception):
    """Root of the errors that this project raises.

    The message says what is wrong, where, and what to do. Command line tools print it as one line
    and exit with `exit_code`.
    """

    exit_code = 2


DECLINED_EXIT_CODE: Final = XrlError.exit_code
"""Exit code of a verb whose question a person answered with no."""
FELL_EXIT_CODE: Final = 1
"""Exit code of a run in which a robot fell, or is about to fall at its end. No XrlError
uses it."""
FAULT_EXIT_CODE: Final = 3
"""Exit code of a check that found a fault or a difference, or nothing to check."""
BUG_EXIT_CODE: Final = 70
"""Exit code of a process that an unforeseen exception ended: a bug of this project (EX_SOFTWARE of
sysexits.h). Python's default would be `FELL_EXIT_CODE`."""
HUNG_UP_EXIT_CODE: Final = 128 + signal.SIGHUP
"""Exit code of a verb whose terminal is gone, as after a dropped ssh session."""


class ConfigError(XrlError):
    """A configuration or scenario file is invalid."""

    def __init__(self, file: str, key: str, found: str, expected: str) -> None:
        """Store the file, the dotted key, the value found and the right value."""
        super().__init__(f"{file}: {key}: {found}; {expected}")
        self.file = file
        self.key = key
        self.found = found
        self.expected = expected


class BusError(XrlError):
    """The bus could not be opened, or a message could not be put on it."""


class EncodeError(BusError):
    """A message holds a value that JSON cannot express; it was not sent."""


class NonFiniteError(EncodeError):
    """A message holds a number that is not finite; it was not sent."""


class DriveError(XrlError):
    """A motor drive did not answer as its protocol says."""


class FleetError(XrlError):
    """The services could not be started, found or stopped."""


class HungUpError(FleetError):
    """The terminal from which a person led the robot was closed."""

    exit_code = HUNG_UP_EXIT_CODE


class RunError(XrlError):
    """A run could not be carried out or its record could not be read."""


class MissingPackageError(RunError):
    """An optional package is not installed or cannot be imported (`shared.extras`)."""


_REMEDIES: Final = {
    errno.ENOSPC: "a disk is full: check the output's disk, /tmp and /dev/shm",
    errno.EDQUOT: "this user's disk quota is used up",
    errno.EROFS: "the disk is read-only: find out why (`dmesg`), then remount or replace it",
    errno.EMFILE: "this process cannot open more files: raise `ulimit -n`",
    errno.ENOMEM: "the machine is out of memory",
}


def os_error_in_words(error: OSError) -> str:
    """Return a system error as one line: the file if known, the error, the remedy."""
    said = error.strerror or str(error) or type(error).__name__
    name = "" if error.filename is None else f"{str(error.filename)[:200]}: "
    remedy = _REMEDIES.get(error.errno or 0, "")
    if error.errno == errno.ENOENT and error.filename is None and not _has_folder():
        remedy = "the working directory was removed: change to another"
    return f"{name}{said}{'; ' if remedy else ''}{remedy}"


def _has_folder() -> bool:
    try:
        os.getcwd()  # noqa: PTH109 - Path.cwd calls it; only its error matters here
    except OSError:
        return False
    return True
