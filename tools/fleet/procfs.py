"""A fleet's processes in Linux's /proc: find, inspect and signal them; tie one to its parent.

Every process of a fleet has the run directory in `FLEET_VARIABLE` of its environment, so
it is found without its supervisor, and a reused process id is never mistaken for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import time
from collections.abc import Iterable
from pathlib import Path

from shared.bus.sockets import established
from shared.run_directory import FLEET_VARIABLE

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_POLL_S = 0.05
_PR_SET_PDEATHSIG = 1
_prctl = ctypes.CDLL(None, use_errno=True).prctl
_SERVICE_VARIABLE = b"SUPERVISOR_PROCESS_NAME="
"""Service name, set by supervisord."""


def fleet_pids(run_dir: Path) -> set[int]:
    """Return the processes of the fleet in this run directory, including the supervisor."""
    pids = (int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdecimal())
    return {pid for pid in pids if pid != os.getpid() and belongs(pid, run_dir)}


def service_pids(run_dir: Path) -> dict[str, int]:
    """Return the process of each service of the fleet, with or without its supervisor."""
    found = {}
    for pid in fleet_pids(run_dir):
        for variable in _environment(pid):
            if variable.startswith(_SERVICE_VARIABLE):
                found[os.fsdecode(variable.removeprefix(_SERVICE_VARIABLE))] = pid
    return found


def belongs(pid: int, run_dir: Path) -> bool:
    """Return True if a process belongs to this user and to the fleet in this run directory."""
    try:
        own = Path(f"/proc/{pid}").stat().st_uid == os.getuid()
    except OSError:
        return False  # it has just ended
    return own and os.fsencode(f"{FLEET_VARIABLE}={run_dir}") in _environment(pid)


def _environment(pid: int) -> list[bytes]:
    """Return a process's variables; empty if it has ended or has another owner."""
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return []


def fleets() -> set[str]:
    """Return the run directories of this user's fleets that have a process."""
    mark = os.fsencode(f"{FLEET_VARIABLE}=")
    found = set()
    for entry in Path("/proc").iterdir():
        variables = _environment(int(entry.name)) if entry.name.isdecimal() else ()
        found |= {os.fsdecode(v.removeprefix(mark)) for v in variables if v.startswith(mark)}
    return found


def connected(pid: int) -> set[tuple[str, int]]:
    """Return the remote ends of a process's TCP connections: numeric address and port."""
    inodes = set()
    with contextlib.suppress(OSError):  # it has just ended
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                found = str(entry.readlink())
                if found.startswith("socket:["):
                    inodes.add(int(found[8:-1]))
    return established(inodes, Path(f"/proc/{pid}/net")) if inodes else set()


def cpu_s_of(pids: Iterable[int]) -> dict[int, float]:
    """Return the CPU time of each process, s; processes that have ended are left out."""
    fields = {pid: _stat(pid) for pid in pids}
    return {pid: (int(f[11]) + int(f[12])) / _TICKS_PER_S for pid, f in fields.items() if f}


def uptime_s(pid: int) -> float:
    """Return the time since a process started; 0 if it has ended."""
    fields = _stat(pid)
    if not fields:
        return 0.0
    return max(0.0, time.clock_gettime(time.CLOCK_BOOTTIME) - int(fields[19]) / _TICKS_PER_S)


def is_suspended(pid: int) -> bool:
    """Return True if the process has been stopped by SIGSTOP."""
    return _stat(pid)[:1] == ["T"]


def is_gone(pid: int) -> bool:
    """Return True if the process has ended: its files, sockets and locks are closed."""
    fields = _stat(pid)
    return not fields or fields[0] in {"Z", "X"}


def _stat(pid: int) -> list[str]:
    """Return the kernel's fields of a process, its state first (proc(5)); empty if it ended."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    return text.rpartition(")")[2].split()  # the name in parentheses may contain anything


def signal_all(pids: Iterable[int], number: int) -> None:
    """Send a signal to each process that still exists."""
    for pid in pids:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            continue


def wait_until_gone(run_dir: Path, timeout_s: float) -> set[int]:
    """Wait until no process of the fleet is left; return those left after the timeout."""
    deadline = time.monotonic() + timeout_s
    left: set[int] = set()
    while True:
        # An ending process loses its environment before its sockets, so once found it is
        # tracked by its id.
        left = {pid for pid in left | fleet_pids(run_dir) if not is_gone(pid)}
        if not left or time.monotonic() > deadline:
            return left
        time.sleep(_POLL_S)


def die_with_parent(parent_pid: int, number: signal.Signals) -> None:
    """Let the kernel send this process a signal when its parent dies.

    Send it at once if the parent died before this call.
    """
    if _prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent_pid:
        os.kill(os.getpid(), number)
