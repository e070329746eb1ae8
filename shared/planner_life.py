"""End of the planner's process, detected immediately by the joint services of its host.

The kernel marks a word of shared memory when the thread whose number is in it ends for any reason
(robust futexes: set_robust_list(2)). Reading the word needs no system call. A pidfd and closed
links show the end 8 to 18 ms later, because the kernel first frees the process's memory. This is a
second trigger besides the age rule (50 ms), which alone covers a planner that hangs or runs on
another host.
"""

from __future__ import annotations

import ctypes
import platform
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from shared import log
from shared.exceptions import FleetError
from shared.run_directory import live_dir, mapped

End = TypeVar("End")

_LIFE: Final = struct.Struct("<QLLQ")
"""Address of the next entry of the list, the word, a gap, the session."""
_WORD_AT, _SESSION_AT = 8, 16
_WORD: Final = struct.Struct("<L")
_SESSION: Final = struct.Struct("<Q")
_SEEN: Final = struct.Struct("<LLQ")
"""Layout of the part that a reader reads: the word and everything after it."""
_OWNER_DIED: Final = 0x4000_0000
"""FUTEX_OWNER_DIED."""
_SET_ROBUST_LIST: Final = {"x86_64": 273, "aarch64": 99}
"""The system call's number, by machine."""


def path_of(run_dir: Path) -> Path:
    """Return the path of the planner's shared memory in a run directory."""
    return live_dir(run_dir) / "planner.life"


class _Head(ctypes.Structure):
    """Linux's `struct robust_list_head`."""

    _fields_ = (
        ("next", ctypes.c_void_p),
        ("futex_offset", ctypes.c_long),
        ("pending", ctypes.c_void_p),
    )


class OwnLife:
    """The planner's side: writes its thread's number and its session into the memory."""

    def __init__(self, run_dir: Path) -> None:
        """Open or create the memory. Keep the object alive: the kernel stores its address.

        Raises:
            FleetError: it cannot be created.
        """
        self._memory = mapped(path_of(run_dir), _LIFE.size)
        self._entry = ctypes.c_char.from_buffer(self._memory)
        entry = ctypes.addressof(self._entry)
        self._head = _Head(entry, _WORD_AT, None)
        self._memory[: _LIFE.size] = _LIFE.pack(ctypes.addressof(self._head), 0, 0, 0)
        self._marked = _set_robust_list(self._head)

    def announce(self, session: int) -> None:
        """Publish the session and the number of this thread, which lives as long as the process."""
        if self._marked:  # otherwise no reader could detect its end
            _WORD.pack_into(self._memory, _WORD_AT, threading.get_native_id())
            _SESSION.pack_into(self._memory, _SESSION_AT, session)


def _set_robust_list(head: _Head) -> bool:
    """Make the kernel mark the entry when this thread ends; False if it cannot.

    This replaces the C library's list for this thread, which must not use a robust mutex.
    """
    number = _SET_ROBUST_LIST.get(platform.machine())
    if number is None:
        return False
    call = ctypes.CDLL(None).syscall
    call.argtypes, call.restype = (ctypes.c_long, ctypes.c_void_p, ctypes.c_size_t), ctypes.c_long
    return bool(call(number, ctypes.addressof(head), ctypes.sizeof(head)) == 0)


class PlannerLife:
    """A joint service's side: watches the planner of its host."""

    def __init__(self, run_dir: Path) -> None:
        """Open or create the memory, as `OwnLife` does."""
        self._memory = mapped(path_of(run_dir), _LIFE.size)
        self._told = 0

    def ended(self) -> int:
        """Return the session of a planner that has ended since the last call, else 0."""
        word, _, session = _SEEN.unpack_from(self._memory, _WORD_AT)
        if not word & _OWNER_DIED or session == self._told:
            return 0
        self._told = int(session)
        return self._told


def if_possible(end: Callable[[Path], End], run_dir: Path) -> End | None:
    """Open one of the two sides; if that fails, log a warning and return None.

    A service can run without this trigger.
    """
    try:
        return end(run_dir)
    except FleetError as error:
        log.get("xrl").warning(
            "%s; a dead planner will be noticed only by the age of its commands", error
        )
        return None
