"""What a joint service that dies leaves to its successor: one byte of shared memory.

What has let go of the robot never takes hold of it again by itself (`shared.fault_table`). A
service that crashes is started again by the supervisor, and a drive may have disarmed in the
meantime, or an emergency stop be in force: the new service would arm it, and stiffen, unasked.
So each writes down what it last was, and a person who asks for the module (`xrl kill`, `xrl start`,
`xrl up`) wipes it out.

A mapped file: writing it is a store to memory, which the control path may do.
"""

from __future__ import annotations

import mmap
from contextlib import suppress
from enum import IntEnum
from pathlib import Path


class Will(IntEnum):
    """What the service before this one was."""

    NOTHING = 0
    """There was none, or it ended in order, or a person has asked for the module anew."""
    HELD = 1
    """It held the robot: a drive that does not any more has let go."""
    DAMP = 2
    """It sank after an emergency stop: so does the next."""


def path_of(run_dir: Path, module: str) -> Path:
    """Return where a module's will is kept."""
    return run_dir / f"{module}.will"


class WillFile:
    """A module's will, in its run directory."""

    def __init__(self, run_dir: Path, module: str) -> None:
        """Open it, or make it; the directory is there."""
        path = path_of(run_dir, module)
        with path.open("a+b") as file:
            if file.seek(0, 2) == 0:
                file.write(bytes([Will.NOTHING]))
                file.flush()
            self._memory = mmap.mmap(file.fileno(), 1)
        self._written = self.read()

    def read(self) -> Will:
        """Return what was left; what is no will is the most careful one that holds."""
        value = self._memory[0]
        return Will(value) if value in tuple(Will) else Will.HELD

    def write(self, will: Will) -> None:
        """Leave this to whoever comes next; what is left already is not written again.

        So `forget` stands, and a service that has nothing new to say does not undo it.
        """
        if will is not self._written:
            self._memory[0] = self._written = will


def forget(run_dir: Path, module: str) -> None:
    """Wipe out what a module's services have left: a person asks for it anew.

    In place, for a service that runs has the file mapped.
    """
    with suppress(FileNotFoundError), path_of(run_dir, module).open("r+b") as file:
        file.write(bytes([Will.NOTHING]))
