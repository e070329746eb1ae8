"""Checks of the computer: processors, clock, real-time permission, USB.

For an emulated robot, a missing capability of a sandbox or a laptop is ok if the services can do
without it (`shared.scheduling`); the row says so.
"""

from __future__ import annotations

import ctypes
import os
import resource
from pathlib import Path
from typing import Final

from shared import scheduling
from shared.config.robot_config import RobotConfig
from shared.extras import libusb_fix
from shared.places import FILES
from shared.robot.compiled_graph import library_of
from tools.bringup.check_socketcan import query_ip, socketcan_rows
from tools.bringup.findings import Finding, advised, judged, ok, warning, wrong
from tools.fleet.process_table import is_simulated
from tools.graph_libraries import command, graphs_of

SUBJECT: Final = "machine"
CPUS_MIN: Final = 2
CPUS_FOR_1_KHZ: Final = 4
"""Two carry the fleet at 500 Hz (docs/results.md)."""
CLOCKS: Final = ("tsc", "arch_sys_counter", "kvm-clock")
"""Clock sources that are read without a system call."""
ODRIVE_VENDOR: Final = "1209"
ODRIVE_PRODUCTS: Final = tuple(f"0d3{i}" for i in range(1, 10))
"""As in deploy/udev/91-odrive.rules."""
UDEV_FIX: Final = (
    f"`sudo cp {FILES}/udev/91-odrive.rules /etc/udev/rules.d/`, then follow its header; "
    "plug in again"
)
LIMIT_FIX: Final = (
    "`YOU - {} {}` in /etc/security/limits.d/xrl.conf and log in again, or systemd's Limit{}={}"
)
CLOCK_FIX: Final = "`sudo apt-get install chrony`, or `sudo timedatectl set-ntp true`"
RTPRIO_FIX: Final = LIMIT_FIX.format("rtprio", 40, "RTPRIO", 40)
MEMLOCK_FIX: Final = LIMIT_FIX.format("memlock", "unlimited", "MEMLOCK", "infinity")

_TIMEX_BYTES: Final = 256
"""At least the size of `struct timex` of <sys/timex.h>; all zeros ask and change nothing."""
_TIME_ERROR: Final = 5
"""State of a clock that is not synchronised."""


def machine_rows(robot: RobotConfig, root: Path = Path("/")) -> list[Finding]:
    """Check the computer; another root of the file system for tests."""
    emulated = is_simulated(robot)
    rows = [_cpus(), _real_time(emulated=emulated), *_delays(root, emulated=emulated)]
    # interpreted, the law's graphs only cost more time
    graphs = graphs_of(robot)
    there = sum(library_of(graph).is_file() for graph in graphs)
    fix = f"with a C compiler `cc`: `{command()} --config FILE`"
    found = f"{there} of {len(graphs)} in C"
    rows.append(advised(there == len(graphs), SUBJECT, "law's graphs", found, "all in C", fix))
    if emulated:
        return rows
    if any(module.serial_number for module in robot.module):
        rows += [_libusb(), *usb_node_rows(root)]
    return rows + socketcan_rows(robot, root, query_ip())


def usb_node_rows(root: Path) -> list[Finding]:
    """Check that the ODrives on USB may be opened by this user."""
    nodes = []
    for device in sorted((root / "sys/bus/usb/devices").glob("*")):
        vendor, product = _text(device / "idVendor"), _text(device / "idProduct")
        if vendor == ODRIVE_VENDOR and product in ODRIVE_PRODUCTS:
            bus, number = _text(device / "busnum"), _text(device / "devnum")
            nodes.append(root / f"dev/bus/usb/{int(bus):03d}/{int(number):03d}")
    if not nodes:
        fix = "plug the USB cables in; settings are read over USB"
        return [warning("USB", "ODrives", "none plugged in", "one for each module", fix)]
    closed = [str(node) for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    found = f"{len(closed)} closed" if closed else f"{len(nodes)} open"
    return [judged(not closed, "USB", "permission", found, "read and write", UDEV_FIX)]


def _cpus() -> Finding:
    cpus = os.sched_getaffinity(0)
    if len(cpus) < CPUS_MIN:
        fix = "another computer, or more of this one's processors (taskset, container)"
        return warning(SUBJECT, "processors", str(len(cpus)), f">= {CPUS_MIN}", fix)
    wanted = f">= {CPUS_MIN}; {CPUS_FOR_1_KHZ} for 1 kHz"
    right, left = (
        ",".join(map(str, sorted(scheduling.half_of(cpus, kind))))
        for kind in ("harness", "planner")
    )
    found = f"{len(cpus)}: right leg {right} | {left} left leg, planner"
    return ok(SUBJECT, "processors", found, wanted)


def _delays(root: Path, *, emulated: bool) -> list[Finding]:
    """Check what makes a loop late now and then; all of it is ok on an emulated robot."""
    governors = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    governor = " and ".join(sorted({_text(file) for file in governors} - {""}))
    clock = _text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    synchronised = clock_is_synchronised()
    may_lock, areas = scheduling.may_lock(), len(_text(root / "proc/swaps").splitlines()) - 1
    locked = f"refused: {resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] // 1024} KiB"
    pause_ms = scheduling.real_time_pause_ms(root)
    rows = (
        (governor in ("", "performance"), "frequency governor", governor or "unknown here",
         "performance", "`sudo cpupower frequency-set -g performance`",
         "a processor that sleeps is late"),
        (clock in ("", *CLOCKS), "clock source", clock or "unknown here", f"{CLOCKS[0]} or alike",
         "see in the kernel's log why it was dropped",
         "every read of the clock costs a system call"),
        (synchronised, "wall clock", "synchronised" if synchronised else "not synchronised",
         "synchronised", CLOCK_FIX,
         "certificates go by it, and records of several hosts are merged by it"),
        (may_lock, "locked memory", "allowed" if may_lock else locked, "allowed", MEMLOCK_FIX,
         "a page that must be read from disk stops a loop"),
        (areas <= 0, "swap", "none" if areas <= 0 else f"{areas} in use", "none",
         "`sudo swapoff -a`",
         "a service that may not lock its memory stops for a page that was swapped out"),
        (pause_ms <= 0.0, "real-time pause", f"{pause_ms:g} ms" if pause_ms else "none", "none",
         f"`sudo cp {FILES}/sysctl/90-xrl.conf /etc/sysctl.d/ && sudo sysctl --system`",
         "for that time of each second the kernel stops what fills a processor: modules hold"),
    )  # fmt: skip
    return [advised(good or emulated, SUBJECT, *row) for good, *row in rows]


def clock_is_synchronised() -> bool:
    """Return True if chrony, systemd-timesyncd or another program keeps the wall clock right."""
    state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    return int(state) != _TIME_ERROR


def _real_time(*, emulated: bool) -> Finding:
    what, wanted = "real-time priority", "SCHED_FIFO"
    if _may_be_fifo():
        return ok(SUBJECT, what, "SCHED_FIFO allowed", wanted)
    fallback = scheduling.short_slice()
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    why = f"the services take {fallback} instead: late when the machine is busy"
    if fallback == "normal priority":
        why = "the loops come late when the machine is busy"
    elif emulated:
        return ok(SUBJECT, what, f"refused; instead: {fallback}", wanted)
    return warning(SUBJECT, what, f"refused, RTPRIO {limit}", wanted, RTPRIO_FIX, why)


def _may_be_fifo() -> bool:
    """Try it and go back: limits, capabilities and control groups all have their say."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(scheduling.TABLE["joint"].fifo))
    except OSError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def _libusb() -> Finding:
    what, wanted = "libusb-1.0", "installed"
    try:
        ctypes.CDLL("libusb-1.0.so.0")
    except OSError:
        return wrong("USB", what, "not found", wanted, libusb_fix(), "no ODrive over USB")
    return ok("USB", what, wanted, wanted)


def _text(path: Path) -> str:
    """Return the contents of a small file of the kernel; "" if it does not exist."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
