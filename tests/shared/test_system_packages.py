"""The command that brings a package of the system."""

from pathlib import Path

import pytest

from shared.extras import libusb_fix


@pytest.mark.parametrize(
    ("manager", "said"),
    [
        ("apt-get", "`sudo apt-get install libusb-1.0-0`"),
        ("dnf", "`sudo dnf install libusb1`"),
        ("", "your package manager (Debian: libusb-1.0-0, Fedora: libusb1)"),
    ],
)
def test_the_command_is_that_of_the_systems_manager(
    manager: str, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    if manager:
        (tmp_path / manager).touch(mode=0o755)
    assert libusb_fix() == said
