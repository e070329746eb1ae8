"""Text files of whatever editor."""

from __future__ import annotations

import codecs
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.simulator.physics import plant
from shared.config import files, gain_schedule, scenarios
from shared.exceptions import ConfigError
from shared.text_file import decoded
from tests.conftest import ROBOT_FILE
from tools.fleet import process_table


@given(st.text())
def test_a_byte_order_mark_says_nothing(text: str) -> None:
    assert decoded(text.encode()).removeprefix("\ufeff") == text.removeprefix("\ufeff")
    assert decoded(codecs.BOM_UTF8 + text.encode()) == text


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("a = 1".encode("UTF-16"), "is UTF-16; save it as UTF-8"),
        ("a = 1".encode("UTF-32"), "is UTF-32; save it as UTF-8"),
        (b"a = 1\nb = 'caf\xe9'", "byte 0xe9 in line 2"),
    ],
)
def test_another_encoding_is_named_and_what_is_no_text_is_told_with_its_line(
    content: bytes, words: str
) -> None:
    with pytest.raises(UnicodeError, match=words):
        decoded(content)


def test_robot_and_gains_of_an_editor_that_marks_them_are_read(tmp_path: Path) -> None:
    for source in (ROBOT_FILE, ROBOT_FILE.with_name("robot.gains.json")):
        content = codecs.BOM_UTF8 + source.read_bytes().replace(b"\n", b"\r\n")
        (tmp_path / source.name).write_bytes(content)
    assert files.load(tmp_path / "robot.toml") == files.load(ROBOT_FILE)


READERS = (files.load, scenarios.load, process_table.load_table, plant.load, gain_schedule.read)


@pytest.mark.parametrize("read", READERS)
def test_a_file_in_utf_16_is_told(read: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes("a = 1\n".encode("utf-16"))
    with pytest.raises(ConfigError, match="UTF-16; save it as UTF-8"):
        read(path)
