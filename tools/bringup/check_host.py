"""Check this host: computer, CAN interfaces, robot file, bus and keys."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import re
import resource
import shlex
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from shared import scheduling
from shared.bus import security
from shared.bus.credentials import keys_folder
from shared.can.drive_settings import CAN_BAUD_RATE
from shared.config import gain_schedule
from shared.config.robot_config import RobotConfig, expand
from shared.exceptions import FleetError, XrlError
from shared.extras import libusb_fix
from shared.joints import MODULES
from shared.places import FILES
from shared.robot.compiled_graph import library_of
from tools.bringup.findings import Finding, advised, judged, ok, warning, wrong
from tools.fleet import process_table
from tools.fleet.process_table import ListenPoint, is_simulated
from tools.graph_libraries import command, graphs_of
from tools.keys.inspection import inspect_keys

MACHINE: Final = "machine"
CPUS_MIN: Final = 2
CPUS_FOR_1_KHZ: Final = 4
"""Minimum numbers of processors, with joint services at 500 Hz and at 1 kHz (docs/results.md)."""
CLOCKS: Final = ("tsc", "arch_sys_counter", "kvm-clock")
"""Clock sources that can be read without a system call."""
ODRIVE_VENDOR: Final = "1209"
ODRIVE_PRODUCTS: Final = tuple(f"0d3{i}" for i in range(1, 10))
"""USB ids of ODrives, as in deploy/udev/91-odrive.rules."""
UDEV_FIX: Final = (
    f"`sudo cp {FILES}/udev/91-odrive.rules /etc/udev/rules.d/`, then follow its header and "
    "plug the boards in again"
)
LIMIT_FIX: Final = (
    "put `YOU - {} {}` in /etc/security/limits.d/xrl.conf and log in again, or set systemd's "
    "Limit{}={}"
)
CLOCK_FIX: Final = "`sudo apt-get install chrony`, or `sudo timedatectl set-ntp true`"
RTPRIO_FIX: Final = LIMIT_FIX.format("rtprio", 40, "RTPRIO", 40)
MEMLOCK_FIX: Final = LIMIT_FIX.format("memlock", "unlimited", "MEMLOCK", "infinity")

_TIMEX_BYTES: Final = 256
"""At least the size of `struct timex`; `adjtimex` changes nothing if all bytes are zero."""
_TIME_ERROR: Final = 5
"""Return value of `adjtimex` if the clock is not synchronised."""


Links = Mapping[str, Mapping[str, Any]]
"""Output of `ip` by interface."""

QUEUE: Final = (32, 100)
"""Valid lengths of a send queue, frames. The kernel's default is 10; deploy/udev/92-can.rules sets
64 and says why. Sending more than 100 frames may take longer than a joint service waits for a
frame (`bus_watch.STUCK_MS`)."""
_IP: Final = ("ip", "-details", "-json", "link", "show", "type", "can")
_IP_S = 2.0
_IFF_UP = 1
_CAP_NET_ADMIN = 12
_WELL: Final = "ERROR-ACTIVE"
_OFF: Final = ("BUS-OFF", "STOPPED", "SLEEPING")

FILE: Final = "robot file"


def machine_rows(robot: RobotConfig, root: Path = Path("/")) -> list[Finding]:
    """Check the computer and, for real drives, USB and CAN. Tests pass another file system root."""
    emulated = is_simulated(robot)
    rows = [_cpus(), _real_time(emulated=emulated), *_delays(root, emulated=emulated)]
    # only a warning, because interpreted graphs are slower but correct
    graphs = graphs_of(robot)
    there = sum(library_of(graph).is_file() for graph in graphs)
    fix = f"install a C compiler `cc` and run `{command()} --config FILE`"
    found = f"{there} of {len(graphs)} in C"
    rows.append(advised(there == len(graphs), MACHINE, "law's graphs", found, "all in C", fix))
    if emulated:
        return rows
    if any(module.serial_number for module in robot.module):
        rows += [_libusb(), *usb_node_rows(root)]
    return rows + socketcan_rows(robot, root, query_ip())


def usb_node_rows(root: Path) -> list[Finding]:
    """Check that this user may open the ODrives on USB."""
    nodes = []
    for device in sorted((root / "sys/bus/usb/devices").glob("*")):
        vendor, product = _text(device / "idVendor"), _text(device / "idProduct")
        if vendor == ODRIVE_VENDOR and product in ODRIVE_PRODUCTS:
            bus, number = _text(device / "busnum"), _text(device / "devnum")
            nodes.append(root / f"dev/bus/usb/{int(bus):03d}/{int(number):03d}")
    if not nodes:
        fix = "plug in the USB cables: settings are read over USB"
        return [warning("USB", "ODrives", "none plugged in", "one for each module", fix)]
    closed = [str(node) for node in nodes if not os.access(node, os.R_OK | os.W_OK)]
    found = f"{len(closed)} closed" if closed else f"{len(nodes)} open"
    return [judged(not closed, "USB", "permission", found, "read and write", UDEV_FIX)]


def _cpus() -> Finding:
    cpus, fix = (
        os.sched_getaffinity(0),
        "allow this process more processors (taskset, container), or use another computer",
    )
    right, left = (
        ",".join(map(str, sorted(scheduling.half_of(cpus, kind))))
        for kind in ("harness", "planner")
    )
    found = f"{len(cpus)}: right leg {right} | {left} left leg, planner"
    wanted = f">= {CPUS_MIN}; {CPUS_FOR_1_KHZ} for 1 kHz"
    return advised(len(cpus) >= CPUS_MIN, MACHINE, "processors", found, wanted, fix)


def _delays(root: Path, *, emulated: bool) -> list[Finding]:
    """Check causes of late cycles; for an emulated robot every row is ok."""
    governors = (root / "sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    governor = " and ".join(sorted({_text(file) for file in governors} - {""}))
    clock = _text(root / "sys/devices/system/clocksource/clocksource0/current_clocksource")
    synchronised = clock_is_synchronised()
    may_lock, areas = scheduling.may_lock(), len(_text(root / "proc/swaps").splitlines()) - 1
    locked = f"refused: {resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] // 1024} KiB"
    pause_ms = scheduling.real_time_pause_ms(root)
    idle = root / scheduling.IDLE_LATENCY
    awake = not idle.exists() or os.access(idle, os.W_OK)
    rows = (
        (governor in ("", "performance"), "frequency governor", governor or "unknown here",
         "performance", "`sudo cpupower frequency-set -g performance`",
         "cycles are late on a processor at a low frequency"),
        (clock in ("", *CLOCKS), "clock source", clock or "unknown here", f"{CLOCKS[0]} or similar",
         "look in the kernel's log for the reason why it rejected tsc",
         "every read of the clock costs a system call"),
        (synchronised, "wall clock", "synchronised" if synchronised else "not synchronised",
         "synchronised", CLOCK_FIX,
         "certificates and merged records of several hosts depend on it"),
        (may_lock, "locked memory", "allowed" if may_lock else locked, "allowed", MEMLOCK_FIX,
         "a loop stops while a page is read from disk"),
        (areas <= 0, "swap", "none" if areas <= 0 else f"{areas} in use", "none",
         "`sudo swapoff -a`",
         "a service that may not lock its memory stops while a page is swapped in"),
        (awake, "idle processors", "stay awake" if awake else "sleep", "stay awake",
         f"`sudo cp {FILES}/udev/93-xrl.rules /etc/udev/rules.d/`, then follow its header",
         "a cycle takes longer on a processor that was asleep"),
        (pause_ms <= 0.0, "real-time pause", f"{pause_ms:g} ms" if pause_ms else "none", "none",
         f"`sudo cp {FILES}/sysctl/90-xrl.conf /etc/sysctl.d/ && sudo sysctl --system`",
         "each second the kernel pauses a task that fills a processor, and modules hold"),
    )  # fmt: skip
    return [advised(good or emulated, MACHINE, *row) for good, *row in rows]


def clock_is_synchronised() -> bool:
    """Return True if chrony, systemd-timesyncd or another program synchronises the wall clock."""
    state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))
    return int(state) != _TIME_ERROR


def _real_time(*, emulated: bool) -> Finding:
    what, wanted = "real-time priority", "SCHED_FIFO"
    # try and restore, because limits, capabilities and control groups all matter
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(scheduling.TABLE["joint"].fifo))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        return ok(MACHINE, what, "SCHED_FIFO allowed", wanted)
    fallback = scheduling.short_slice()
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    why = f"the services use {fallback} instead, and are late when the machine is busy"
    if fallback == "normal priority":
        why = "the loops are late when the machine is busy"
    elif emulated:
        return ok(MACHINE, what, f"refused; instead: {fallback}", wanted)
    return warning(MACHINE, what, f"refused, RTPRIO {limit}", wanted, RTPRIO_FIX, why)


def _libusb() -> Finding:
    what, wanted = "libusb-1.0", "installed"
    try:
        ctypes.CDLL("libusb-1.0.so.0")
    except OSError:
        return wrong(
            "USB", what, "not found", wanted, libusb_fix(), "no access to ODrives over USB"
        )
    return ok("USB", what, wanted, wanted)


def _text(path: Path) -> str:
    """Return the contents of a small kernel file, or "" if it does not exist."""
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def query_ip() -> Links:
    """Return the output of `ip` by CAN interface; empty if `ip` is missing or fails."""
    try:
        output = subprocess.run(_IP, capture_output=True, timeout=_IP_S, check=True).stdout
        return {link["ifname"]: link for link in json.loads(output or "[]") if "ifname" in link}
    except (OSError, subprocess.SubprocessError, ValueError):
        return {}


def socketcan_rows(robot: RobotConfig, root: Path, links: Links) -> list[Finding]:
    """Check each CAN interface of the robot, by files below `root` and by `query_ip`'s `links`."""
    rows = []
    for name in _interfaces_of(robot):
        flags = _text(root / "sys/class/net" / name / "flags")
        if not flags:
            fix = "plug in the adapter; `ip link` lists the interfaces"
            rows.append(wrong(name, "interface", "missing", "up", fix))
            continue
        up = bool(int(flags, 16) & _IFF_UP)
        rows.append(judged(up, name, "interface", "up" if up else "down", "up", up_command(name)))
        if up and name in links:
            rows += _details(root, name, links[name])
    return rows


def _interfaces_of(robot: RobotConfig) -> list[str]:
    """Return the interfaces that a robot's buses use."""
    used = [robot.can[name] for name in robot.buses]
    return sorted({bus.channel for bus in used if bus.interface == "socketcan"})


def up_command(name: str) -> str:
    """Return the command that brings an interface up."""
    return f"`sudo ip link set {name} up type can bitrate {CAN_BAUD_RATE} restart-ms 100`"


def _details(root: Path, name: str, link: Mapping[str, Any]) -> list[Finding]:
    """Judge an interface that is up, from the values that `ip` reports."""
    data = link.get("linkinfo", {}).get("info_data", {})
    again = f"`sudo ip link set {name} down`, then {up_command(name)}"
    rows = []
    bitrate, state = data.get("bittiming", {}).get("bitrate"), data.get("state")
    if bitrate is not None:
        good = abs(bitrate / CAN_BAUD_RATE - 1.0) < 1e-3
        why = "no frame gets through, and every node reports errors"
        rows.append(judged(good, name, "bit rate", str(bitrate), str(CAN_BAUD_RATE), again, why))
    if state is not None:
        errors, wanted = data.get("berr_counter", {}), _WELL.lower()
        counted = f" (errors sent {errors.get('tx', 0)}, received {errors.get('rx', 0)})"
        found = state.lower() + (counted if any(errors.values()) else "")
        fix = "check 120 ohm at both ends only, the ground wire, equal bit rates, and short stubs"
        why = "frames are resent and arrive late, or the controller goes bus-off"
        row = advised(state == _WELL, name, "controller", found, wanted, fix, why)
        if state in _OFF:
            why = "the interface neither sends nor receives"
            row = wrong(name, "controller", found, wanted, again, why)
        rows.append(row)
    if "LISTEN-ONLY" in data.get("ctrlmode", ()):
        fix = f"`sudo ip link set {name} down`, then set it up with `listen-only off`"
        rows.append(wrong(name, "mode", "listen-only", "normal", fix, "nothing can be sent"))
    if data.get("restart_ms") == 0:
        why = "after bus-off, for example from a short circuit, the interface stays down"
        rows.append(warning(name, "restart-ms", "0: off", "100", again, why))
    length = link.get("txqlen")
    if length is not None:
        low, high = QUEUE
        found, wanted = f"{length} frames", f"{low} to {high}"
        fix = f"install {FILES}/udev/92-can.rules, or `sudo ip link set {name} txqueuelen 64`"
        why = "too short: it overflows at arming; too long: a reconnected drive gets old frames"
        good = low <= length <= high
        rows.append(advised(good, name, "send queue", found, wanted, fix, why))
    # in one-shot mode the controller drops unacknowledged frames, so no restart is needed
    return rows if "ONE-SHOT" in data.get("ctrlmode", ()) else rows + _restart_rows(root, name)


def _restart_rows(root: Path, name: str) -> list[Finding]:
    """Judge whether the joint services (this process, if none runs) may restart an interface."""
    services = [
        path.parent for path in root.glob("proc/[0-9]*/cmdline") if "services.joint" in _text(path)
    ]
    capabilities = [
        re.search(r"CapEff:\s*(\w+)", _text(folder / "status"))
        for folder in services or [root / "proc/self"]
    ]
    allowed = [int(one[1], 16) >> _CAP_NET_ADMIN & 1 for one in capabilities if one is not None]
    if len(allowed) < len(capabilities):
        return []  # a process has ended, or this is not Linux
    fix = "run them from the unit of `xrl hosts`, or grant CAP_NET_ADMIN (docs/drives.md)"
    why = "about a dozen frames wait in the queue during a power cut, and then reach the drive"
    found = "allowed" if all(allowed) else "not allowed"
    what = "restart by the services"
    return [advised(all(allowed), name, what, found, "allowed", fix, why)]


def robot_rows(robot: RobotConfig, path: Path) -> list[Finding]:
    """Check a robot file that was read without errors."""
    count = len(robot.assumed)
    found = f"{count} value{'s' * (count != 1)} assumed" if count else "all values measured"
    if count and process_table.is_simulated(robot):
        assumed = ok(FILE, "assumed", f"{found}; the emulated drives use them")
    elif count:
        fix = f"measure {', '.join(robot.assumed)}; then remove them from `assumed`"
        assumed = warning(FILE, "assumed", found, "none", fix)
    else:
        assumed = ok(FILE, "assumed", found, "none")
    rows = [ok(FILE, "read", str(path)), assumed]
    if robot.law.split == "certified":
        stale = gain_schedule.why_stale(robot)
        fix = f"`xrl gains --config {shlex.quote(str(path))}`"
        rows.append(judged(not stale, FILE, "gain schedule", stale or "fits", "fits", fix))
    return rows


def services_up(robot: RobotConfig, run_dir: Path) -> tuple[str, ...]:
    """Return the services that listen on their endpoints, of any user or program."""
    here = security.services_here(robot)
    return tuple(
        service
        for service in robot.services
        if process_table.is_listening(expand(security.endpoint_here(robot, service, here), run_dir))
    )


def joint_services_up(robot: RobotConfig, run_dir: Path) -> tuple[str, ...]:
    """Return the joint services that listen on their endpoints."""
    return tuple(service for service in services_up(robot, run_dir) if service in MODULES)


def endpoint_rows(robot: RobotConfig, run_dir: Path, *, fleet_is_up: bool) -> list[Finding]:
    """Check that the endpoints of the bus are free, or in use by the fleet."""
    what = "endpoints"
    if fleet_is_up:
        up = services_up(robot, run_dir)
        found = f"{len(up)} of {len(robot.services)} listen"
        silent = [module for module in MODULES if module not in up]
        if len(silent) in (0, len(MODULES)):
            return [ok("bus", what, found, "the fleet's")]
        fix = f"`xrl status` shows why these do not listen: {', '.join(silent)}"
        return [wrong("bus", what, found, "all six modules", fix)]
    here = security.services_here(robot)
    listeners = [
        ListenPoint(service, f"bus.endpoints.{service}", expand(endpoint, run_dir))
        for service in robot.bus.endpoints
        for endpoint in security.listening(robot, service, here)
        if not process_table.is_elsewhere(expand(endpoint, run_dir))
    ]
    try:
        process_table.check_free(listeners)
    except FleetError as error:
        return [wrong("bus", what, str(error), "free", "run `xrl down`, or use another --run-dir")]
    return [ok("bus", what, f"{len(listeners)} free", "free")]


def security_rows(robot: RobotConfig) -> list[Finding]:
    """Check `bus.security`, and under `mtls` each certificate that this host holds."""
    mode = robot.bus.security.mode
    if mode == "open":
        fix = 'set mode = "mtls", or "local" for one host (docs/security.md)'
        why = "anyone who can reach a port can command the robot"
        return [warning("bus", "security", mode, "mtls or local", fix, why)]
    if mode == "local":
        return [ok("bus", "security", mode, "only this user may connect")]
    try:
        keys = inspect_keys(keys_folder(robot), robot)
    except XrlError as error:
        return [wrong("bus", "keys", str(error), "this host's own", "`xrl keys pack`")]
    rows = []
    for key in keys:
        what, until = f"key of {key.name}", f"from {key.begins} until {key.expires}"
        if key.wrong:
            row = wrong("bus", what, key.wrong, "valid", "`xrl keys check`", "links fail")
        else:
            why = "after expiry new links fail; existing links stay"
            found = key.warning or until
            row = advised(not key.warning, "bus", what, found, "valid", "`xrl keys renew`", why)
        rows.append(row)
    return rows
