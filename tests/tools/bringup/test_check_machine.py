"""What the doctor says of the computer, by a file system that the test writes."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from shared import scheduling
from shared.config.robot_config import RobotConfig
from shared.places import DEFAULT_CONFIG
from tools.bringup import check_machine
from tools.bringup.findings import Finding, FindingKind

ROOT = DEFAULT_CONFIG.parents[1]
CPU = "sys/devices/system/cpu"
KERNEL = "proc/sys/kernel"


def write(root: Path, path: str, text: str) -> None:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text + "\n", encoding="utf-8")


def row_of(rows: list[Finding], what: str) -> Finding:
    return next(row for row in rows if row.what == what)


@pytest.mark.parametrize(
    ("path", "text", "what"),
    [
        (f"{CPU}/cpu0/cpufreq/scaling_governor", "powersave", "frequency governor"),
        ("sys/devices/system/clocksource/clocksource0/current_clocksource", "hpet", "clock source"),
        ("proc/swaps", "Filename Type\n/swapfile file", "swap"),
        (f"{KERNEL}/sched_rt_runtime_us", "950000", "real-time pause"),
    ],
)
def test_a_slow_loop_is_a_warning_on_a_real_robot_and_a_note_on_an_emulated_one(
    robot: RobotConfig, real: RobotConfig, tmp_path: Path, path: str, text: str, what: str
) -> None:
    write(tmp_path, f"{KERNEL}/sched_rt_period_us", "1000000")
    write(tmp_path, path, text)
    for config, verdict in ((real, FindingKind.WARNING), (robot, FindingKind.OK)):
        row = row_of(check_machine.machine_rows(config, tmp_path), what)
        assert row.verdict is verdict
        assert row.found != row.wanted


@pytest.mark.parametrize(
    ("synchronised", "verdict"), [(False, FindingKind.WARNING), (True, FindingKind.OK)]
)
def test_a_wall_clock_that_nothing_keeps_right_is_warned_of_on_a_real_robot(
    real: RobotConfig, monkeypatch: pytest.MonkeyPatch, synchronised: bool, verdict: FindingKind
) -> None:
    monkeypatch.setattr(check_machine, "clock_is_synchronised", lambda: synchronised)
    assert row_of(check_machine.machine_rows(real), "wall clock").verdict is verdict


def test_one_processor_that_sleeps_is_seen(real: RobotConfig, tmp_path: Path) -> None:
    for cpu, governor in enumerate(("performance", "powersave", "performance")):
        write(tmp_path, f"{CPU}/cpu{cpu}/cpufreq/scaling_governor", governor)
    row = row_of(check_machine.machine_rows(real, tmp_path), "frequency governor")
    assert (row.verdict, row.found) == (FindingKind.WARNING, "performance and powersave")


def test_a_kernel_without_the_figure_is_ok(robot: RobotConfig, tmp_path: Path) -> None:
    rows = check_machine.machine_rows(robot, tmp_path)
    assert row_of(rows, "frequency governor").found == "unknown here"
    assert {row.verdict for row in rows} == {FindingKind.OK}


@pytest.mark.parametrize(
    ("granted", "emulated", "verdict"),
    [
        ("slice 100000 ns", True, FindingKind.OK),
        ("slice 100000 ns", False, FindingKind.WARNING),
        ("normal priority", True, FindingKind.WARNING),
    ],
)
def test_without_real_time_permission_the_services_fallback_is_named(
    monkeypatch: pytest.MonkeyPatch, granted: str, emulated: bool, verdict: FindingKind
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(scheduling, "short_slice", lambda: granted)
    row = check_machine._real_time(emulated=emulated)
    assert row.verdict is verdict
    assert "refused" in row.found
    if verdict is FindingKind.OK:
        assert granted in row.found


def test_real_time_is_tried_and_not_kept(robot: RobotConfig, tmp_path: Path) -> None:
    before = os.sched_getscheduler(0)
    check_machine.machine_rows(robot, tmp_path)
    assert os.sched_getscheduler(0) == before


def plug_in(root: Path, product: str = "0d32") -> Path:
    device = {"idVendor": "1209", "idProduct": product, "busnum": "1", "devnum": "7"}
    for name, text in device.items():
        write(root, f"sys/bus/usb/devices/1-2/{name}", text)
    node = root / "dev/bus/usb/001/007"
    node.parent.mkdir(parents=True)
    node.touch()
    return node


def test_an_odrive_that_may_not_be_opened_wants_its_udev_rule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = plug_in(tmp_path)
    (row,) = check_machine.usb_node_rows(tmp_path)
    assert row.verdict is FindingKind.OK
    real_access: Callable[..., bool] = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: Path(path) != node and real_access(path, mode)
    )
    (row,) = check_machine.usb_node_rows(tmp_path)
    assert row.verdict is FindingKind.WRONG
    (rules,) = (ROOT / word for word in row.fix.split() if word.endswith(".rules"))
    ids = re.search(r'idVendor}=="1209", ATTR\{idProduct\}=="(0d3\[\d-\d\])"', rules.read_text())
    assert ids is not None
    named = [f"{i:04x}" for i in range(1 << 16) if re.fullmatch(ids[1], f"{i:04x}")]
    assert tuple(named) == check_machine.ODRIVE_PRODUCTS, "the rule is for what the doctor finds"


def test_other_usb_devices_are_not_taken_for_odrives(tmp_path: Path) -> None:
    plug_in(tmp_path, product="beef")
    (row,) = check_machine.usb_node_rows(tmp_path)
    assert row.verdict is FindingKind.WARNING
    assert "none plugged in" in row.found
