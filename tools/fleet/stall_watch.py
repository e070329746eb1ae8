"""Idle real-time threads, one a core: what delays them is the machine, and nothing that runs on it.

But where real-time processes fill a core, the kernel stops these threads too
(`shared.scheduling.real_time_pause_ms`).

Run as a program (`python stall_watch.py FILE PID`) it appends a line for each gap, and ends with
PID, the process that started it. It imports the standard library alone, so that it is up at once.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple, Self

PERIOD_NS: Final = 4_000_000
GAP_NS: Final = 20_000_000
"""A delay beyond the period that counts: with some milliseconds of network, an age of 50 ms."""
PRIORITY: Final = 30
"""Above every service (`shared.scheduling`), and within the limit that docs/bring-up.md sets."""
CORES_MAX: Final = 8
"""With more cores one thread wanders: so many wake-ups would be a load of their own."""
ANY_CORE: Final = -1
"""No thread was bound to a core."""
UNSURE: Final = -2
"""The same, and without real time: a busy machine looks like one that stands still."""
_STEAL_EVERY: Final = 50
_STEAL_FIELD: Final = 8
_NS_PER_TICK: Final = 1_000_000_000 // os.sysconf("SC_CLK_TCK")


class Gap(NamedTuple):
    """Time in which a core ran nothing in real time. All times are of CLOCK_MONOTONIC."""

    end_ns: int
    lasted_ns: int
    core: int
    """Its number, `ANY_CORE` or `UNSURE`."""
    stolen_ns: int
    """So much of it the host of a virtual machine took away, by /proc/stat, in ticks of 10 ms."""


class StallWatch:
    """The program beside a fleet, from `__enter__` to `__exit__`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Self:
        """Start."""
        self._path.touch()
        self._file = self._path.open("rb")
        # a session of its own: Ctrl-C in the terminal is for the tool alone, and Ctrl-Z no stall
        self._process = subprocess.Popen(
            command(self._path), stdin=subprocess.DEVNULL, start_new_session=True
        )
        return self

    @property
    def pid(self) -> int:
        """The program's process."""
        return self._process.pid

    def __exit__(self, *_: object) -> None:
        """End the program."""
        self._process.kill()
        self._process.wait()
        self._file.close()

    def take(self) -> list[Gap]:
        """Return the gaps since the last call."""
        lines = self._file.readlines()
        if lines and not lines[-1].endswith(b"\n"):  # the rest is being written
            self._file.seek(-len(lines.pop()), os.SEEK_CUR)
        return [Gap(*map(int, line.split())) for line in lines]


def command(path: Path) -> list[str]:
    """Return the program's words; it ends with this process."""
    return [sys.executable, "-I", "-S", __file__, str(path), str(os.getpid())]


def watch(path: Path, parent: int) -> None:
    """Write gaps until the process that started this one is no more."""
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND)
    cores = sorted(os.sched_getaffinity(0))
    # A thread without real time waits its turn: on its core it would take other work for a stall.
    real_time = _takes_real_time()
    bound = real_time and len(cores) <= CORES_MAX
    for core in cores[1:] if bound else ():
        threading.Thread(target=_watch_core, args=(descriptor, core, parent)).start()
    _watch_core(descriptor, cores[0] if bound else ANY_CORE if real_time else UNSURE, parent)


def _takes_real_time() -> bool:
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))  # threads inherit it
        return True
    return False


def _watch_core(descriptor: int, core: int, parent: int) -> None:
    if core >= 0:
        os.sched_setaffinity(0, {core})
    looks, stolen_ns, last_ns = 0, _stolen_ns(core), time.monotonic_ns()
    while os.getppid() == parent:
        time.sleep(PERIOD_NS / 1e9)
        now_ns = time.monotonic_ns()
        lasted_ns = now_ns - last_ns - PERIOD_NS
        looks += 1
        if lasted_ns > GAP_NS:
            before_ns, stolen_ns = stolen_ns, _stolen_ns(core)
            taken_ns = min(lasted_ns, stolen_ns - before_ns)
            os.write(descriptor, b"%d %d %d %d\n" % (now_ns, lasted_ns, core, taken_ns))
        elif looks % _STEAL_EVERY == 0:
            stolen_ns = _stolen_ns(core)
        last_ns = now_ns


def _stolen_ns(core: int) -> int:
    """Return the time stolen from a core since the machine started; of all cores together."""
    name = b"cpu%d " % core if core >= 0 else b"cpu "
    for line in Path("/proc/stat").read_bytes().splitlines():
        if line.startswith(name):
            fields = line.split()
            return int(fields[_STEAL_FIELD]) * _NS_PER_TICK if len(fields) > _STEAL_FIELD else 0
    return 0


if __name__ == "__main__":
    watch(Path(sys.argv[1]), int(sys.argv[2]))
