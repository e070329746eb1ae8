"""Raises a process's scheduling priority, with privilege or without (docs/networks.md).

Call it before the bus is opened: the bus's threads inherit it.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
from typing import Final

_PR_SET_TIMERSLACK: Final = 29
_SCHED_SETATTR: Final = {"x86_64": 314, "aarch64": 274, "armv7l": 380}
_SCHED_ATTR: Final = struct.Struct("=IIQiIQQQ")
"""size, policy, flags, nice, priority, runtime, deadline, period."""
SLICE_NS: Final = 100_000
"""The shortest slice that the kernel gives: a short slice is a near deadline (EEVDF)."""
TIMER_SLACK_NS: Final = 1_000
"""Sleeps end so close to their time; the default is 50 us."""


def raise_priority(fifo_priority: int) -> str:
    """Set SCHED_FIFO, or what needs no privilege; return what was granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(fifo_priority))
    except (OSError, AttributeError):
        return short_slice()
    return f"SCHED_FIFO {fifo_priority}"


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
