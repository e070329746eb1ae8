"""Checks of the computer: processors, clock, real-time permission, USB, CAN interfaces.

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
from tools.bringup.rows import Finding, FindingKind, judged, ok, warning, wrong
from tools.fleet.process_table import is_simulated
from tools.graph_libraries import command, graphs_of

SUBJECT: Final = "machine"
CPUS_MIN: Final = 2
CPUS_FOR_1_KHZ: Final = 4
"""Two carry the fleet at 500 Hz (CHANGELOG.md)."""
CLOCKS: Final = ("tsc", "arch_sys_counter", "kvm-clock")
"""Clock sources that are read without a system call."""
ODRIVE_VENDOR: Final = "1209"
ODRIVE_PRODUCTS: Final = tuple(f"0d3{i}" for i in range(1, 10))
"""As in deploy/udev/91-odrive.rules."""
UDEV_FIX: Final = (
    f"`sudo cp {FILES}/udev/91-odrive.rules /etc/udev/rules.d/` and what its head says; "
    "plug in again"
)
RTPRIO_FIX: Final = (
    "`YOU - rtprio 40` in /etc/security/limits.d/xrl.conf and log in again, or systemd's "
    "LimitRTPRIO=40"
)

MEMLOCK_FIX: Final = (
    "`YOU - memlock unlimited` in /etc/security/limits.d/xrl.conf and log in again, or systemd's "
    "LimitMEMLOCK=infinity"
)


def machine_rows(robot: RobotConfig, root: Path = Path("/")) -> list[Finding]:
    """Check the computer.

    Args:
        robot: says whether its drives are emulated ones, and which interfaces it needs.
        root: of the file system; another one for tests.
    """
    emulated = is_simulated(robot)
    rows = [
        _cpus(),
        _governor(root, emulated=emulated),
        _clock(root, emulated=emulated),
        _real_time(emulated=emulated),
        _memory(emulated=emulated),
        _swap(root, emulated=emulated),
        _graphs(robot),
    ]
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
    count = len(os.sched_getaffinity(0))
    if count < CPUS_MIN:
        fix = "another computer, or more of this one's processors (taskset, container)"
        return warning(SUBJECT, "processors", str(count), f">= {CPUS_MIN}", fix)
    wanted = f">= {CPUS_MIN}; {CPUS_FOR_1_KHZ} for 1 kHz"
    halves = (scheduling.half_of(os.sched_getaffinity(0), kind) for kind in ("harness", "planner"))
    listed = " | ".join(",".join(map(str, sorted(half))) for half in halves)
    return ok(SUBJECT, "processors", f"{count}: right leg {listed} left leg, planner", wanted)


def _graphs(robot: RobotConfig) -> Finding:
    """Check that the law's graphs run as C; interpreted they only cost more time."""
    graphs = graphs_of(robot)
    there = sum(library_of(graph).is_file() for graph in graphs)
    found, wanted = f"{there} of {len(graphs)} in C", "all in C"
    if there == len(graphs):
        return ok(SUBJECT, "law's graphs", found, wanted)
    fix = f"with a C compiler `cc`: `{command()} --config FILE`"
    return warning(SUBJECT, "law's graphs", found, wanted, fix)


def _governor(root: Path, *, emulated: bool) -> Finding:
    files = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    found = sorted({_text(file) for file in files} - {""})
    if not found:
        return ok(SUBJECT, "frequency governor", "unknown here", "performance")
    return judged(
        found == ["performance"] or emulated,
        SUBJECT,
        "frequency governor",
        " and ".join(found),
        "performance",
        "`sudo cpupower frequency-set -g performance`",
        "a processor that sleeps is late",
        otherwise=FindingKind.WARNING,
    )


def _clock(root: Path, *, emulated: bool) -> Finding:
    found = _text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    return judged(
        found in CLOCKS or not found or emulated,
        SUBJECT,
        "clock source",
        found or "unknown here",
        f"{CLOCKS[0]} or alike",
        "look in the kernel's log why it was given up",
        "every look at the clock costs a system call",
        otherwise=FindingKind.WARNING,
    )


def _real_time(*, emulated: bool) -> Finding:
    what, wanted = "real-time priority", "SCHED_FIFO"
    if _may_be_fifo():
        return ok(SUBJECT, what, "SCHED_FIFO allowed", wanted)
    fallback = scheduling.short_slice()
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    if fallback == "normal priority":
        why = "the loops come late when the machine is busy"
        return warning(SUBJECT, what, f"refused, RTPRIO {limit}", wanted, RTPRIO_FIX, why)
    if emulated:
        return ok(SUBJECT, what, f"refused; instead: {fallback}", wanted)
    why = f"the services take {fallback} instead: late when the machine is busy"
    return warning(SUBJECT, what, f"refused, RTPRIO {limit}", wanted, RTPRIO_FIX, why)


def _may_be_fifo() -> bool:
    """Try it and go back: limits, capabilities and control groups all have their say."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(scheduling.TABLE["joint"].fifo))
    except OSError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def _memory(*, emulated: bool) -> Finding:
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    may = scheduling.may_lock()
    return judged(
        may or emulated,
        SUBJECT,
        "locked memory",
        "allowed" if may else f"refused: {limit // 1024} KiB",
        "allowed",
        MEMLOCK_FIX,
        "a page that has to be read again stops a loop",
        otherwise=FindingKind.WARNING,
    )


def _swap(root: Path, *, emulated: bool) -> Finding:
    areas = len(_text(root / "proc/swaps").splitlines()) - 1
    return judged(
        areas <= 0 or emulated,
        SUBJECT,
        "swap",
        "none" if areas <= 0 else f"{areas} in use",
        "none",
        "`sudo swapoff -a`",
        "a service that may not lock its memory stops for a page that was swapped out",
        otherwise=FindingKind.WARNING,
    )


def _libusb() -> Finding:
    try:
        ctypes.CDLL("libusb-1.0.so.0")
    except OSError:
        return wrong(
            "USB", "libusb-1.0", "not found", "installed", libusb_fix(), "no ODrive over USB"
        )
    return ok("USB", "libusb-1.0", "installed", "installed")


def _text(path: Path) -> str:
    """Return the contents of a small file of the kernel; "" if it does not exist."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
