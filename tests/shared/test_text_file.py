"""Text files of whatever editor."""

from __future__ import annotations

import codecs
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.physics import plant
from shared.config import files, scenarios
from shared.exceptions import ConfigError
from shared.text_file import decoded, read_text
from tests.conftest import ROBOT_FILE
from tools.fleet import process_table


@given(st.text())
def test_a_byte_order_mark_says_nothing(text: str) -> None:
    assert decoded(text.encode()).removeprefix("\ufeff") == text.removeprefix("\ufeff")
    assert decoded(codecs.BOM_UTF8 + text.encode()) == text


@pytest.mark.parametrize("name", ["UTF-16", "UTF-32"])
def test_another_encoding_is_named(name: str) -> None:
    with pytest.raises(UnicodeError, match=f"is {name}; save it as UTF-8"):
        decoded("a = 1".encode(name))


def test_what_is_no_text_is_told_with_its_line() -> None:
    with pytest.raises(UnicodeError, match="byte 0xe9 in line 2"):
        decoded(b"a = 1\nb = 'caf\xe9'")


def test_robot_and_gains_of_an_editor_that_marks_them_are_read(tmp_path: Path) -> None:
    for source in (ROBOT_FILE, ROBOT_FILE.with_name("robot.gains.json")):
        content = codecs.BOM_UTF8 + source.read_bytes().replace(b"\n", b"\r\n")
        (tmp_path / source.name).write_bytes(content)
    assert files.load(tmp_path / "robot.toml") == files.load(ROBOT_FILE)


@pytest.mark.parametrize("read", [files.load, scenarios.load, process_table.load_table, plant.load])
def test_a_file_in_utf_16_is_told(read: object, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes("a = 1\n".encode("utf-16"))
    assert callable(read)
    with pytest.raises(ConfigError, match="UTF-16; save it as UTF-8"):
        read(path)


def test_a_schedule_in_utf_16_is_told(tmp_path: Path) -> None:
    shutil.copy(ROBOT_FILE, tmp_path / "robot.toml")
    gains = read_text(ROBOT_FILE.with_name("robot.gains.json"))
    (tmp_path / "robot.gains.json").write_text(gains, encoding="utf-16")
    with pytest.raises(ConfigError, match="is no gain schedule: is UTF-16; save it as UTF-8"):
        files.load(tmp_path / "robot.toml")
