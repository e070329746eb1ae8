"""Checks of the kernel's CAN interfaces: present, up, and set as the drives and services need.

Bit rate, state and restart are not in sysfs and come from `ip`, which needs no privilege and
changes nothing.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from shared.can.drive_settings import CAN_BAUD_RATE
from shared.config.robot_config import RobotConfig
from shared.places import FILES
from tools.bringup.findings import Finding, advised, judged, warning, wrong

Links = Mapping[str, Mapping[str, Any]]
"""By interface: what `ip` says of it."""

QUEUE: Final = (32, 100)
"""Frames. deploy/udev/92-can.rules sets 64 and says why; the kernel's default is 10. More than 100
take longer than a joint service waits for a frame to be carried (`bus_watch.STUCK_MS`)."""
_IP: Final = ("ip", "-details", "-json", "link", "show", "type", "can")
_IP_S = 2.0
_IFF_UP = 1
_CAP_NET_ADMIN = 12
_WELL: Final = "ERROR-ACTIVE"
_OFF: Final = ("BUS-OFF", "STOPPED", "SLEEPING")


def query_ip() -> Links:
    """Return the output of `ip` for the CAN interfaces; nothing without that command."""
    try:
        output = subprocess.run(_IP, capture_output=True, timeout=_IP_S, check=True).stdout
        return {link["ifname"]: link for link in json.loads(output or "[]") if "ifname" in link}
    except (OSError, subprocess.SubprocessError, ValueError):
        return {}


def socketcan_rows(robot: RobotConfig, root: Path, links: Links) -> list[Finding]:
    """Check every interface that the robot uses, by the file system and by `query_ip`."""
    rows = []
    for name in interfaces_of(robot):
        flags = _flags(root, name)
        if flags is None:
            fix = "plug the adapter in; `ip link` lists what is there"
            rows.append(wrong(name, "interface", "not there", "up", fix))
            continue
        up = bool(flags & _IFF_UP)
        rows.append(judged(up, name, "interface", "up" if up else "down", "up", up_command(name)))
        if up and name in links:
            rows += _details(root, name, links[name])
    return rows


def interfaces_of(robot: RobotConfig) -> list[str]:
    """Return the interfaces that a robot's buses use."""
    used = [robot.can[name] for name in robot.buses]
    return sorted({bus.channel for bus in used if bus.interface == "socketcan"})


def setup_commands(name: str) -> list[list[str]]:
    """Return the commands that bring an interface up as the drives and services need it."""
    up = ["type", "can", "bitrate", str(CAN_BAUD_RATE), "restart-ms", "100"]
    return [
        ["ip", "link", "set", name, "down"],
        ["ip", "link", "set", name, "up", *up],
        ["ip", "link", "set", name, "txqueuelen", "64"],
    ]


def up_command(name: str) -> str:
    """Return how an interface is brought up."""
    return f"`sudo ip link set {name} up type can bitrate {CAN_BAUD_RATE} restart-ms 100`"


def _details(root: Path, name: str, link: Mapping[str, Any]) -> list[Finding]:
    """Judge an interface that is up by the output of `ip`; a missing value is not judged."""
    data = link.get("linkinfo", {}).get("info_data", {})
    again = f"`sudo ip link set {name} down`, then {up_command(name)}"
    rows = []
    bitrate = data.get("bittiming", {}).get("bitrate")
    if bitrate is not None:
        good = abs(bitrate / CAN_BAUD_RATE - 1.0) < 1e-3
        why = "not one frame gets through, and every node reports errors"
        rows.append(judged(good, name, "bit rate", str(bitrate), str(CAN_BAUD_RATE), again, why))
    if "state" in data:
        rows.append(_state(name, str(data["state"]), data.get("berr_counter", {}), again))
    if "LISTEN-ONLY" in data.get("ctrlmode", ()):
        fix = f"`sudo ip link set {name} down`, then with `listen-only off`"
        rows.append(wrong(name, "mode", "listen-only", "normal", fix, "nothing can be sent"))
    if data.get("restart_ms") == 0:
        why = "after bus-off, as after a short, it stays down"
        rows.append(warning(name, "restart-ms", "0: off", "100", again, why))
    length = link.get("txqlen")
    if length is not None:
        low, high = QUEUE
        found, wanted = f"{length} frames", f"{low} to {high}"
        fix = f"{FILES}/udev/92-can.rules, or `sudo ip link set {name} txqueuelen 64`"
        why = "too short: it overflows at arming; too long: a plugged-in drive gets old frames"
        good = low <= length <= high
        rows.append(advised(good, name, "send queue", found, wanted, fix, why))
    # in one-shot mode the controller itself drops a frame that nobody acknowledges
    return rows if "ONE-SHOT" in data.get("ctrlmode", ()) else rows + _restart_rows(root, name)


def _restart_rows(root: Path, name: str) -> list[Finding]:
    """Judge whether the joint services, or else this process, may restart an interface."""
    services = [path.parent for path in root.glob("proc/[0-9]*/cmdline") if _is_service(path)]
    allowed = [_may_restart(folder) for folder in services or [root / "proc/self"]]
    if None in allowed:
        return []
    fix = "run them by the unit of `xrl hosts`, or grant CAP_NET_ADMIN (docs/drives.md)"
    why = "a dozen frames stay in the queue through a power cut, and reach the drive after it"
    found = "allowed" if all(allowed) else "not allowed"
    what = "restart by the services"
    return [advised(all(allowed), name, what, found, "allowed", fix, why)]


def _is_service(cmdline: Path) -> bool:
    try:
        return b"services.joint" in cmdline.read_bytes()
    except OSError:
        return False


def _may_restart(process: Path) -> bool | None:
    """Return True if a process has CAP_NET_ADMIN; None: it is gone, or this is no Linux."""
    try:
        status = (process / "status").read_text(encoding="ascii")
        capabilities = status.split("CapEff:")[1].split()[0]
        return bool(int(capabilities, 16) >> _CAP_NET_ADMIN & 1)
    except (OSError, IndexError, ValueError):
        return None


def _state(name: str, state: str, errors: Mapping[str, Any], again: str) -> Finding:
    counted = f" (errors sent {errors.get('tx', 0)}, received {errors.get('rx', 0)})"
    found = state.lower() + (counted if any(errors.values()) else "")
    if state in _OFF:
        return wrong(name, "controller", found, _WELL.lower(), again, "it takes no part in the bus")
    wires = "120 ohm at both ends and nowhere else, ground wired along, one bit rate, short stubs"
    why = "frames are resent and arrive late, or the bus goes off"
    return advised(state == _WELL, name, "controller", found, _WELL.lower(), wires, why)


def _flags(root: Path, name: str) -> int | None:
    try:
        return int((root / "sys/class/net" / name / "flags").read_text(encoding="utf-8"), 16)
    except (OSError, ValueError):
        return None
