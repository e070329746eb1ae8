from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from shared.mcap_log import provenance


def git(root: Path, *arguments: str) -> None:
    who = ("-c", "user.name=t", "-c", "user.email=t@example.invalid", "-c", "commit.gpgsign=false")
    subprocess.run(("git", "-C", str(root), *who, *arguments), check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    git(tmp_path, "init", "--quiet")
    (tmp_path / "file").write_text("one")
    git(tmp_path, "add", "file")
    git(tmp_path, "commit", "--quiet", "--message", "one")
    return tmp_path


def test_a_clean_checkout_has_a_commit_and_is_not_dirty(checkout: Path) -> None:
    found = provenance.code(checkout)
    assert len(found["git_commit"]) == 40
    assert found["git_dirty"] == "false"


def test_a_changed_file_makes_the_checkout_dirty(checkout: Path) -> None:
    (checkout / "file").write_text("two")
    assert provenance.code(checkout)["git_dirty"] == "true"


def test_a_directory_inside_another_checkout_is_unknown(checkout: Path) -> None:
    installed = checkout / "site-packages"
    installed.mkdir()
    assert provenance.code(installed) == {"git_commit": "unknown", "git_dirty": "unknown"}


def test_a_checkout_without_a_commit_is_unknown(tmp_path: Path) -> None:
    git(tmp_path, "init", "--quiet")
    assert provenance.code(tmp_path)["git_commit"] == "unknown"


def test_without_git_the_code_is_unknown(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert provenance.code(checkout)["git_commit"] == "unknown"


def test_the_cpu_has_a_name_with_and_without_cpuinfo(tmp_path: Path) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text("processor : 0\nmodel name\t: Brand 9000\n")
    assert provenance.cpu_model(cpuinfo) == "Brand 9000"
    assert provenance.cpu_model(tmp_path / "absent")


def test_machine_and_packages_are_text_and_name_what_changes_bits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    machine = provenance.machine()
    assert '"OPENBLAS_NUM_THREADS":"1"' in machine["thread_env"]
    assert all(isinstance(value, str) and value for value in machine.values())
    assert {"numpy", "msgspec", "mcap"} <= set(provenance.packages())
