from __future__ import annotations

from pathlib import Path

import pytest

from shared.mcap_log import provenance


def test_the_cpu_has_a_name_with_and_without_cpuinfo(tmp_path: Path) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor : 0\nmodel name\t: Brand 9000\n")
    assert provenance.cpu_model(cpuinfo) == "Brand 9000"
    assert provenance.cpu_model(tmp_path / "absent")


def test_an_arm_cpu_is_named_by_its_cores_each_kind_once(tmp_path: Path) -> None:
    """Linux gives no model name there: two boards would be the same machine, an unknown one."""
    little, big = "CPU implementer\t: 0x41\nCPU part\t: 0xd05\n", "0x41\nCPU part\t: 0xd0b\n"
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"processor\t: 0\n{little}{little}CPU implementer\t: {big}")
    assert provenance.cpu_model(cpuinfo) == "0x41 part 0xd05, 0x41 part 0xd0b"


def test_machine_and_packages_are_text_and_name_what_changes_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    machine = provenance.machine()
    assert '"OPENBLAS_NUM_THREADS":"1"' in machine["thread_env"]
    assert all(isinstance(value, str) and value for value in machine.values())
    assert {"architecture", "libc", "python", "cpu_model"} <= set(machine)
    assert {"casadi", "msgspec", "numpy", "pin"} <= set(provenance.packages())
