"""Death of the planner's process, seen at once by the joint services of its host.

The kernel marks a word of shared memory when the thread that put its number there ends, however it
ends (robust futexes: set_robust_list(2)). A reader only reads memory, without a system call. A
descriptor of the process (pidfd) and its closed links show the end 8 to 18 ms later, because its
memory is torn down first. This is a second trigger beside the age rule (50 ms), which alone covers
a planner that hangs or runs on another host.
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
"""Layout of what a reader reads, from the word on."""
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
    """The planner's side: its thread's number in the word, and the session in which it leads."""

    def __init__(self, run_dir: Path) -> None:
        """Open or create the memory. Keep the object alive: the kernel holds its address.

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
        """Publish that this thread, which lives as long as the process, leads in a session."""
        if self._marked:  # otherwise nobody would see its end
            _WORD.pack_into(self._memory, _WORD_AT, threading.get_native_id())
            _SESSION.pack_into(self._memory, _SESSION_AT, session)


def _set_robust_list(head: _Head) -> bool:
    """Make the kernel mark the entry when this thread ends; False if it cannot.

    This replaces the C library's list for this thread: it must use no robust mutex.
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
        """Open the memory, as `OwnLife`."""
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
    """Return one of the two sides, or None and a warning: no service fails for a second trigger."""
    try:
        return end(run_dir)
    except FleetError as error:
        log.get("xrl").warning(
            "%s; only the age of its commands will show that a planner has ended", error
        )
        return None
