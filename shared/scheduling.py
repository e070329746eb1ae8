"""Priority, processors and locked memory of each process, from one table (docs/networks.md).

Call `apply` before the bus is opened: the bus's threads inherit priority and processors.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import struct
from collections.abc import Collection
from pathlib import Path
from typing import Final, Literal, NamedTuple

from shared.joints import SIDES, side_of

PINNED_VARIABLE: Final = "XRL_PINNED"
"""Environment variable; "1" keeps each process on its half of the processors. The fleet's process
table sets it (`deploy/processes.toml`)."""


class _ProcessSchedule(NamedTuple):
    """Row of one kind of process."""

    fifo: int
    """SCHED_FIFO priority, 1 .. 99."""
    half: Literal["first", "second", "by leg"]
    """Half of the processors: a leg and the processes that feed it share their caches."""


TABLE: Final[dict[str, _ProcessSchedule]] = {
    "simulator": _ProcessSchedule(25, "first"),
    "joint": _ProcessSchedule(20, "by leg"),
    "planner": _ProcessSchedule(15, "second"),
    "network_proxy": _ProcessSchedule(15, "first"),
    "harness": _ProcessSchedule(10, "first"),
    "imu": _ProcessSchedule(10, "first"),
    "recorder": _ProcessSchedule(5, "second"),
}
"""Rows by kind of process. The right leg is on the first half, the left leg on the second. Without
real-time priority the recorder lost 600 and 1200 messages in two demos, on any processor."""

_PR_SET_TIMERSLACK: Final = 29
_SCHED_SETATTR: Final = {"x86_64": 314, "aarch64": 274, "armv7l": 380}
_SCHED_ATTR: Final = struct.Struct("=IIQiIQQQ")
"""size, policy, flags, nice, priority, runtime, deadline, period."""
SLICE_NS: Final = 100_000
"""Shortest slice that the kernel grants; a short slice gives an early deadline (EEVDF)."""
TIMER_SLACK_NS: Final = 1_000
"""Maximum delay at the end of a sleep; the default is 50 us."""
NO_PAUSE: Final = "kernel.sched_rt_runtime_us=-1"
"""Kernel setting (deploy/sysctl) that, before Linux 6.12, disables the pause that
`real_time_pause_ms` returns."""
IDLE_LATENCY: Final = "dev/cpu_dma_latency"
"""Kernel file for the maximum wake-up time of an idle processor (PM QoS)."""
_CAP_IPC_LOCK: Final = 14
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def apply(kind: str, module: str = "") -> str:
    """Set this process's priority, processors and locked memory, by its kind in `TABLE`.

    Returns a description of what was granted.
    """
    granted = [raise_priority(TABLE[kind].fifo)]
    if os.environ.get(PINNED_VARIABLE) == "1":
        granted.append(_pin(half_of(os.sched_getaffinity(0), kind, module)))
    if _lock_memory():
        granted.append("memory locked")
    return ", ".join(granted)


def half_of(processors: Collection[int], kind: str, module: str = "") -> set[int]:
    """Return a process's half of the available processors; if there is only one, all share it."""
    half = TABLE[kind].half
    if half == "by leg":
        half = "first" if side_of(module) == SIDES[0] else "second"
    ordered = sorted(processors, key=_core_of)
    middle = (len(ordered) + 1) // 2
    return set(ordered[:middle] if half == "first" else ordered[middle:] or ordered)


def _core_of(processor: int) -> tuple[int, int, int]:
    """Return a sort key that makes two threads of a core neighbours."""
    topology = Path(f"/sys/devices/system/cpu/cpu{processor}/topology")
    try:
        package, core = (
            int((topology / name).read_text()) for name in ("physical_package_id", "core_id")
        )
    except (OSError, ValueError):
        return (0, processor, processor)
    return (package, core, processor)


def _pin(processors: set[int]) -> str:
    try:
        os.sched_setaffinity(0, processors)
    except (OSError, AttributeError):
        return "all processors"
    return f"processors {','.join(map(str, sorted(processors)))}"


def raise_priority(fifo: int) -> str:
    """Set SCHED_FIFO, or a fallback that needs no privilege; return what was granted."""
    limit_us = _real_time_limit_us()
    if limit_us is not None:
        return (
            f"{short_slice()}, no real time: RLIMIT_RTTIME of {limit_us} us would end the process"
        )
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(fifo))
    except (OSError, AttributeError):
        return short_slice()
    return f"SCHED_FIFO {fifo}"


def keep_processors_awake(root: Path = Path("/")) -> int | None:
    """Keep idle processors awake as long as the returned descriptor stays open; None if refused.

    A processor that sleeps between two cycles wakes up slowly and with cold caches: in three pairs
    of runs the fleet took 8 to 19 % less processor time on processors that stayed awake.
    """
    try:
        held = os.open(root / IDLE_LATENCY, os.O_WRONLY)
        os.write(held, bytes(4))  # 0 us
    except OSError:
        return None
    return held


def has_real_time(pid: int) -> bool | None:
    """Return True if a process has a real-time priority; None if there is no such process."""
    try:
        return os.sched_getscheduler(pid) in (os.SCHED_FIFO, os.SCHED_RR)
    except OSError:
        return None


def real_time_pause_ms(root: Path = Path("/")) -> float:
    """Return how long the kernel pauses real-time processes that fill a processor, ms.

    The default is 50 ms of each second. Returns 0 if it never does so, or if unknown.
    """
    kernel = root / "proc/sys/kernel"
    try:
        period_us, runtime_us = (
            int((kernel / f"sched_rt_{name}_us").read_text()) for name in ("period", "runtime")
        )
    except (OSError, ValueError):
        return 0.0
    return max(0.0, (period_us - runtime_us) / 1e3) if runtime_us >= 0 else 0.0


def _real_time_limit_us() -> int | None:
    """Lift the limit on uninterrupted real-time computing; return what remains of it, us, or None.

    Beyond it the kernel ends a process (SIGXCPU, then SIGKILL), but a long cycle must not end a
    service.
    """
    soft, _hard = resource.getrlimit(resource.RLIMIT_RTTIME)
    if soft == resource.RLIM_INFINITY:
        return None
    try:
        resource.setrlimit(resource.RLIMIT_RTTIME, (resource.RLIM_INFINITY,) * 2)
    except (OSError, ValueError):  # the hard limit is lower, and only root may raise it
        return soft
    return None


def short_slice() -> str:
    """Set a short scheduling slice and exact timers; return what was granted."""
    libc = ctypes.CDLL(None, use_errno=True)
    granted = []
    if libc.prctl(_PR_SET_TIMERSLACK, TIMER_SLACK_NS, 0, 0, 0) == 0:
        granted.append(f"timer slack {TIMER_SLACK_NS} ns")
    number = _SCHED_SETATTR.get(platform.machine())
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    attributes = _SCHED_ATTR.pack(_SCHED_ATTR.size, os.SCHED_OTHER, 0, nice, 0, SLICE_NS, 0, 0)
    if number is not None and libc.syscall(number, 0, attributes, 0) == 0:
        granted.append(f"slice {SLICE_NS} ns")
    return ", ".join(granted) or "normal priority"


def _lock_memory() -> bool:
    """Keep in memory every page that this process has touched or will touch; True if granted.

    Pages that are never touched, such as most of each thread's stack, take no memory. If locking is
    limited, nothing is locked, because an allocation beyond the limit would fail in operation.
    """
    if not may_lock():
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    done: int = libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    return done == 0


def may_lock() -> bool:
    """Return True if this process may lock memory without a limit."""
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    return unlimited or _has_capability(_CAP_IPC_LOCK)


def _has_capability(bit: int) -> bool:
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return False
    effective = [int(line.split()[1], 16) for line in lines if line.startswith("CapEff:")]
    return bool(effective) and bool(effective[0] >> bit & 1)
