"""A user may have neither a name nor a home, as in a container."""

from __future__ import annotations

import getpass
import os
from pathlib import Path

import pytest

from shared.exceptions import XrlError
from shared.user import in_home, user_name


@pytest.mark.parametrize("error", [KeyError("uid not found: 12345"), OSError(), ImportError()])
def test_a_user_without_a_name_has_a_number(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def unknown() -> str:
        raise error

    monkeypatch.setattr(getpass, "getuser", unknown)
    assert user_name() == f"uid {os.getuid()}"


@pytest.mark.parametrize(
    ("name", "shown"), [("anna", "anna"), ("l\udce9a", "l?a"), ("a\n\x1b", "a"), ("\n", None)]
)
def test_a_name_can_be_printed_and_sent(
    monkeypatch: pytest.MonkeyPatch, name: str, shown: str | None
) -> None:
    monkeypatch.setenv("LOGNAME", name)
    assert user_name() == (shown or f"uid {os.getuid()}")


def test_a_home_is_filled_in_and_a_whole_path_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/anna")
    assert in_home("~/.config") == Path("/home/anna/.config")
    assert in_home("/etc/~x") == Path("/etc/~x")
    with pytest.raises(XrlError, match=r"~nobody-of-this-name/x: .* set HOME"):
        in_home("~nobody-of-this-name/x")


def test_without_a_home_a_path_in_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", unknown)
    with pytest.raises(XrlError, match=r"~/x: .* set HOME, or write a whole path"):
        in_home("~/x")
