"""What the doctor says of the kernel's CAN interfaces, by what `ip` says of them."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from shared.config.robot_config import RobotConfig
from tests.tools.bringup.verdicts import OK, WARNING, WRONG, bad
from tools.bringup import check_host
from tools.bringup.check_host import socketcan_rows
from tools.bringup.findings import Finding, FindingKind

UP, DOWN = "0x40081", "0x40080"


def flag(root: Path, name: str, flags: str) -> None:
    folder = root / "sys/class/net" / name
    folder.mkdir(parents=True)
    (folder / "flags").write_text(flags + "\n", encoding="utf-8")


def link(length: int = 64, bitrate: int = 1_000_000, **data: Any) -> dict[str, Any]:
    """Return an interface as iproute2 prints it with -details -json."""
    healthy = {
        "state": "ERROR-ACTIVE",
        "berr_counter": {"tx": 0, "rx": 0},
        "restart_ms": 100,
        "bittiming": {"bitrate": bitrate, "sample_point": "0.750"},
    }
    info = {"info_kind": "can", "info_data": healthy | data}
    return {"ifname": "can0", "txqlen": length, "linkinfo": info}


def rows_of(real: RobotConfig, root: Path, said: dict[str, Any]) -> list[Finding]:
    flag(root, "can0", UP)
    return [row for row in socketcan_rows(real, root, {"can0": said}) if row.subject == "can0"]


def test_interfaces_are_there_and_up(real: RobotConfig, tmp_path: Path) -> None:
    flag(tmp_path, "can0", UP)
    flag(tmp_path, "can1", DOWN)
    rows = {row.subject: row for row in socketcan_rows(real, tmp_path, {})}
    assert [rows[f"can{i}"].found for i in range(3)] == ["up", "down", "not there"]
    assert "ip link set can1 up type can bitrate 1000000" in rows["can1"].fix


def test_an_interface_that_is_set_as_it_should_be_is_ok(real: RobotConfig, tmp_path: Path) -> None:
    rows = rows_of(real, tmp_path, link())
    assert {row.verdict for row in rows} == {OK}
    assert {"interface", "bit rate", "controller", "send queue"} <= {row.what for row in rows}


@pytest.mark.parametrize(
    ("said", "what", "verdict"),
    [
        (link(bitrate=500_000), "bit rate", WRONG),
        (link(state="BUS-OFF"), "controller", WRONG),
        (link(state="STOPPED"), "controller", WRONG),
        (link(state="ERROR-PASSIVE"), "controller", WARNING),
        (link(state="ERROR-WARNING"), "controller", WARNING),
        (link(ctrlmode=["LISTEN-ONLY"]), "mode", WRONG),
        (link(restart_ms=0), "restart-ms", WARNING),
        (link(length=10), "send queue", WARNING),
        (link(length=101), "send queue", WARNING),
    ],
)
def test_what_stops_or_delays_frames_is_named(
    real: RobotConfig, tmp_path: Path, said: dict[str, Any], what: str, verdict: FindingKind
) -> None:
    rows = rows_of(real, tmp_path, said)
    assert bad(rows) == [f"can0: {what}: {verdict}"]
    assert all(row.fix for row in rows if row.verdict != OK)


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
    rows = rows_of(real, tmp_path, link(ctrlmode=modes))
    assert [row.found for row in rows if row.what == "restart by the services"] == found


def test_counted_errors_are_reported(real: RobotConfig, tmp_path: Path) -> None:
    rows = rows_of(real, tmp_path, link(berr_counter={"tx": 96, "rx": 3}))
    assert "errors sent 96, received 3" in next(r.found for r in rows if r.what == "controller")


def test_what_ip_does_not_report_is_not_judged(real: RobotConfig, tmp_path: Path) -> None:
    (row,) = rows_of(real, tmp_path, {"ifname": "can0", "linkinfo": {"info_kind": "vcan"}})
    assert (row.what, row.verdict) == ("interface", OK)


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
