"""What the doctor says of the computer, its CAN interfaces, and of who may link to the bus."""

from __future__ import annotations

import datetime as dt
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from shared import scheduling
from shared.config.robot_config import RobotConfig
from shared.exceptions import FleetError
from shared.places import DEFAULT_CONFIG
from tests.certified import certified, opened
from tools.bringup import check_host, drive_access
from tools.bringup.check_host import machine_rows, security_rows, socketcan_rows
from tools.bringup.findings import Finding, FindingKind
from tools.keys import authority as authority_module

OK, WARNING, WRONG = FindingKind.OK, FindingKind.WARNING, FindingKind.WRONG
CPU, KERNEL = "sys/devices/system/cpu", "proc/sys/kernel"
CLOCK = "sys/devices/system/clocksource/clocksource0/current_clocksource"


def write(root: Path, path: str, text: str) -> None:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text + "\n", encoding="utf-8")


def row_of(rows: list[Finding], what: str) -> Finding:
    return next(row for row in rows if row.what == what)


@pytest.mark.parametrize(
    ("files", "what", "found"),
    [
        ({f"{CPU}/cpu0/cpufreq/scaling_governor": "powersave"}, "frequency governor", "powersave"),
        ({f"{CPU}/cpu{i}/cpufreq/scaling_governor": name for i, name in
          enumerate(("performance", "powersave", "performance"))},
         "frequency governor", "performance and powersave"),
        ({CLOCK: "hpet"}, "clock source", "hpet"),
        ({"proc/swaps": "Filename Type\n/swapfile file"}, "swap", "1 in use"),
        ({f"{KERNEL}/sched_rt_runtime_us": "950000", f"{KERNEL}/sched_rt_period_us": "1000000"},
         "real-time pause", "50 ms"),
    ],
)  # fmt: skip
def test_a_slow_loop_is_a_warning_on_a_real_robot_and_a_note_on_an_emulated_one(
    robot: RobotConfig, real: RobotConfig, tmp_path: Path, files: dict[str, str], what: str,
    found: str,
) -> None:  # fmt: skip
    for path, text in files.items():
        write(tmp_path, path, text)
    for config, verdict in ((real, WARNING), (robot, OK)):
        row = row_of(machine_rows(config, tmp_path), what)
        assert (row.verdict, row.found) == (verdict, found)


def test_processors_that_sleep_are_warned_of_where_the_supervisor_may_not_keep_them_awake(
    real: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, scheduling.IDLE_LATENCY, "")
    assert row_of(machine_rows(real, tmp_path), "idle processors").verdict is OK
    monkeypatch.setattr(os, "access", lambda _path, mode: mode != os.W_OK)
    assert row_of(machine_rows(real, tmp_path), "idle processors").verdict is WARNING


@pytest.mark.parametrize(
    ("synchronised", "verdict"), [(False, FindingKind.WARNING), (True, FindingKind.OK)]
)
def test_a_wall_clock_that_nothing_keeps_right_is_warned_of_on_a_real_robot(
    real: RobotConfig, monkeypatch: pytest.MonkeyPatch, synchronised: bool, verdict: FindingKind
) -> None:
    monkeypatch.setattr(check_host, "clock_is_synchronised", lambda: synchronised)
    assert row_of(machine_rows(real), "wall clock").verdict is verdict


def test_a_kernel_without_the_figures_is_ok_and_real_time_is_tried_and_not_kept(
    robot: RobotConfig, tmp_path: Path
) -> None:
    before = os.sched_getscheduler(0)
    rows = machine_rows(robot, tmp_path)
    assert row_of(rows, "frequency governor").found == "unknown here"
    assert {row.verdict for row in rows} == {OK}
    assert os.sched_getscheduler(0) == before


@pytest.mark.parametrize(
    ("granted", "emulated", "verdict"),
    [
        ("slice 100000 ns", True, OK),
        ("slice 100000 ns", False, WARNING),
        ("normal priority", True, WARNING),
    ],
)
def test_without_real_time_permission_the_services_fallback_is_named(
    monkeypatch: pytest.MonkeyPatch, granted: str, emulated: bool, verdict: FindingKind
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(scheduling, "short_slice", lambda: granted)
    row = check_host._real_time(emulated=emulated)
    assert row.verdict is verdict
    assert "refused" in row.found
    assert verdict is not OK or granted in row.found


def plug_in(root: Path, product: str = "0d32") -> Path:
    device = {"idVendor": "1209", "idProduct": product, "busnum": "1", "devnum": "7"}
    for name, text in device.items():
        write(root, f"sys/bus/usb/devices/1-2/{name}", text)
    write(root, "dev/bus/usb/001/007", "")
    return root / "dev/bus/usb/001/007"


def test_an_odrive_that_may_not_be_opened_wants_its_udev_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = plug_in(tmp_path)
    (row,) = check_host.usb_node_rows(tmp_path)
    assert row.verdict is OK
    real_access: Callable[..., bool] = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: Path(path) != node and real_access(path, mode)
    )
    (row,) = check_host.usb_node_rows(tmp_path)
    assert row.verdict is WRONG
    root = DEFAULT_CONFIG.parents[1]
    (rules,) = (root / word for word in row.fix.split() if word.endswith(".rules"))
    ids = re.search(r'idVendor}=="1209", ATTR\{idProduct\}=="(0d3\[\d-\d\])"', rules.read_text())
    assert ids is not None
    named = [f"{i:04x}" for i in range(1 << 16) if re.fullmatch(ids[1], f"{i:04x}")]
    assert tuple(named) == check_host.ODRIVE_PRODUCTS, "the rule is for what the doctor finds"


def test_other_usb_devices_are_not_taken_for_odrives(tmp_path: Path) -> None:
    plug_in(tmp_path, product="beef")
    (row,) = check_host.usb_node_rows(tmp_path)
    assert (row.verdict, row.found) == (WARNING, "none plugged in")


# ---- the kernel's CAN interfaces, by what `ip` says of them


def link(length: int = 64, bitrate: int = 1_000_000, **data: Any) -> dict[str, Any]:
    """Return an interface as iproute2 prints it with -details -json."""
    healthy = {
        "state": "ERROR-ACTIVE", "berr_counter": {"tx": 0, "rx": 0}, "restart_ms": 100,
        "bittiming": {"bitrate": bitrate, "sample_point": "0.750"},
    }  # fmt: skip
    info = {"info_kind": "can", "info_data": healthy | data}
    return {"ifname": "can0", "txqlen": length, "linkinfo": info}


def rows_of(real: RobotConfig, root: Path, said: dict[str, Any]) -> list[Finding]:
    write(root, "sys/class/net/can0/flags", "0x40081")
    return [row for row in socketcan_rows(real, root, {"can0": said}) if row.subject == "can0"]


def test_interfaces_are_there_and_up(real: RobotConfig, tmp_path: Path) -> None:
    write(tmp_path, "sys/class/net/can0/flags", "0x40081")
    write(tmp_path, "sys/class/net/can1/flags", "0x40080")
    rows = {row.subject: row for row in socketcan_rows(real, tmp_path, {})}
    assert [rows[f"can{i}"].found for i in range(3)] == ["up", "down", "missing"]
    assert "ip link set can1 up type can bitrate 1000000" in rows["can1"].fix


@pytest.mark.parametrize(
    ("said", "wrong"),
    [
        (link(), []),
        ({"ifname": "can0", "linkinfo": {"info_kind": "vcan"}}, []),
        (link(bitrate=500_000), ["bit rate: wrong"]),
        (link(state="BUS-OFF"), ["controller: wrong"]),
        (link(state="STOPPED"), ["controller: wrong"]),
        (link(state="ERROR-PASSIVE"), ["controller: warning"]),
        (link(state="ERROR-WARNING"), ["controller: warning"]),
        (link(ctrlmode=["LISTEN-ONLY"]), ["mode: wrong"]),
        (link(restart_ms=0), ["restart-ms: warning"]),
        (link(length=10), ["send queue: warning"]),
        (link(length=101), ["send queue: warning"]),
    ],
)
def test_what_stops_or_delays_frames_is_named(
    real: RobotConfig, tmp_path: Path, said: dict[str, Any], wrong: list[str]
) -> None:
    rows = rows_of(real, tmp_path, said)
    assert [f"{row.what}: {row.verdict}" for row in rows if row.verdict is not OK] == wrong
    assert all(row.fix for row in rows if row.verdict is not OK)


def process(root: Path, number: str, command: bytes, capabilities: int) -> None:
    folder = root / "proc" / number
    folder.mkdir(parents=True)
    (folder / "cmdline").write_bytes(command)
    (folder / "status").write_text(f"Name:\tx\nCapEff:\t{capabilities:016x}\nSeccomp:\t0\n")


@pytest.mark.parametrize(
    ("capabilities", "service", "modes", "found"),
    [
        (1 << 12, 1 << 12, [], ["allowed"]),
        (0, 0, [], ["not allowed"]),
        (1 << 12, 0, [], ["not allowed"]),
        (0, 1 << 12, [], ["allowed"]),
        (0, None, [], ["not allowed"]),
        (0, 0, ["ONE-SHOT"], []),
    ],
)
def test_services_that_cannot_throw_old_frames_away_are_named(
    real: RobotConfig, tmp_path: Path, capabilities: int, service: int | None, modes: list[str],
    found: list[str],
) -> None:  # fmt: skip
    """Of the services if they are up, of this process otherwise; one-shot leaves no old frame."""
    process(tmp_path, "self", b"xrl\0doctor", capabilities)
    if service is not None:
        process(tmp_path, "77", b"python\0-m\0services.joint\0hip_left", service)
    rows = rows_of(real, tmp_path, link(ctrlmode=modes, berr_counter={"tx": 96, "rx": 3}))
    assert [row.found for row in rows if row.what == "restart by the services"] == found
    assert "errors sent 96, received 3" in row_of(rows, "controller").found


@pytest.mark.parametrize("said", [b"", b"[]", b"[{}]", b"no JSON", None])
def test_no_ip_command_or_its_unusable_output_yields_nothing(
    monkeypatch: pytest.MonkeyPatch, said: bytes | None
) -> None:
    def run(*_: object, **__: object) -> subprocess.CompletedProcess[bytes]:
        if said is None:
            raise FileNotFoundError
        return subprocess.CompletedProcess([], 0, stdout=said)

    monkeypatch.setattr(subprocess, "run", run)
    assert check_host.query_ip() == {}


def test_a_robot_file_with_one_bus_forgotten_never_finds_emulated_drives_right(
    robot: RobotConfig, real: RobotConfig, tmp_path: Path
) -> None:
    """Its USB would be the emulated one, and every setting there is as wanted."""
    half = msgspec.structs.replace(real, can=real.can | {"harness": robot.can["harness"]})
    drives = drive_access.drives_within_reach(half, tmp_path / "robot.toml", tmp_path / "r")
    with pytest.raises(FleetError, match=r"\[can\.harness\] is emulated"), drives:
        pass
    assert not (tmp_path / "r").exists()


# ---- who may link to the bus


def verdicts(robot: RobotConfig) -> set[FindingKind]:
    return {row.verdict for row in security_rows(robot)}


def test_sockets_of_one_host_are_ok_and_an_open_port_is_told(robot: RobotConfig) -> None:
    assert verdicts(robot) == {OK}
    (row,) = security_rows(opened(robot, robot.bus.endpoints))
    assert row.verdict is WARNING
    assert "anyone" in row.why


def test_each_key_of_a_certified_host_has_its_row(robot: RobotConfig, tmp_path: Path) -> None:
    own, authority = certified(robot, tmp_path)
    assert verdicts(own) == {OK}
    assert len(security_rows(own)) == 1 + len(authority.names.generations), "and the authority's"
    authority.renew(own, ["planner"], days=20)
    made, kept = tmp_path / "authority", tmp_path / "keys"
    (kept / "planner.pem").write_bytes((made / "planner.pem").read_bytes())
    wrong = [row for row in security_rows(own) if row.verdict is WRONG]
    assert [row.what for row in wrong] == ["key of planner.1"], "a certificate without its key"
    (kept / "planner.key").write_bytes((made / "planner.key").read_bytes())
    assert verdicts(own) == {OK, WARNING}
    security = msgspec.structs.replace(own.bus.security, keys=str(tmp_path / "nowhere"))
    bus = msgspec.structs.replace(own.bus, security=security)
    assert verdicts(msgspec.structs.replace(own, bus=bus)) == {WRONG}, "a host without keys"


@pytest.mark.parametrize(("days", "told"), [(30, "not valid before"), (-4000, "expired at")])
def test_a_clock_outside_the_time_of_the_authority_and_its_certificates_is_told(
    robot: RobotConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: int, told: str
) -> None:
    """As on a board whose clock has lost its battery: it is before, or long after, their time."""
    made = dt.datetime.now(dt.UTC) + dt.timedelta(days=days)
    clock = SimpleNamespace(UTC=dt.UTC, datetime=SimpleNamespace(now=lambda _zone: made))
    monkeypatch.setattr(authority_module, "dt", clock)
    own, authority = certified(robot, tmp_path)
    rows = security_rows(own)
    assert len(rows) == 1 + len(authority.names.generations)
    assert all(row.verdict is WRONG and told in row.found for row in rows)
