"""The door to a terminal, a pipe or a file."""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich import box
from rich.table import Table
from rich.text import Text

from tools.guarded_streams import cleaned, guarded_streams
from tools.terminal import Console, marked

LONG = "joint/knee_left/state, and more than eighty columns of words beside it, all of them needed"
NUMBERS = [f"{number}.25" for number in range(100, 118)]
OURS = re.compile(r"\x1b\[[0-9;]*m")
"""A colour or a style."""
HOSTILE = st.text(
    st.characters() | st.sampled_from("\x1b\x07\x9b\x9d\x00\r\u202e\u2028[]/\\{}\n"), max_size=40
)


def printed(*what: object, terminal: bool, width: int = 80) -> str:
    file = io.StringIO()
    colours = {"force_terminal": True, "width": width, "color_system": "standard"}
    Console(file=file, **(colours if terminal else {})).print(*what)
    return file.getvalue()


def table() -> Table:
    made = Table(box=box.SIMPLE_HEAD)
    made.add_column("topic", no_wrap=True)
    for _ in NUMBERS[:7]:
        made.add_column("value", justify="right", no_wrap=True)
    made.add_row(LONG, *NUMBERS[:7])
    return made


def test_a_pipe_gets_a_table_whole_without_frame_and_colour() -> None:
    text = printed(table(), terminal=False)
    header, row = text.splitlines()
    assert row.split() == [*LONG.split(), *NUMBERS[:7]]
    assert header.split() == ["topic", *["value"] * 7]
    assert text.isascii()
    assert "\x1b" not in text


def test_in_a_pipe_no_row_ends_in_blanks_though_one_cell_is_long() -> None:
    made = Table("what", "found")
    made.add_row("a", "x" * 3000)
    made.add_row("b", "fine")
    lines = printed(made, terminal=False).splitlines()
    assert lines == ["what  found", f"a     {'x' * 3000}", "b     fine"]


@pytest.mark.parametrize("width", [40, 80, 100])
def test_a_terminal_folds_a_table_and_cuts_nothing(width: int) -> None:
    text = OURS.sub("", printed(table(), terminal=True, width=width))
    assert "…" not in text
    assert all(len(line) <= width for line in text.splitlines())
    kept = "".join(re.findall(r"[a-z_/,\d.]", text))
    words = ["topic", *["value"] * 7, *LONG.split(), *NUMBERS[:7]]
    assert sorted(kept) == sorted("".join(words))


def test_numbers_stay_in_one_line_where_the_text_beside_them_can_fold() -> None:
    text = OURS.sub("", printed(table(), terminal=True))
    assert all(number in text for number in NUMBERS[:7])


@given(HOSTILE)
def test_no_foreign_control_character_passes_whatever_prints_it(text: str) -> None:
    cells = Table("head")
    cells.add_row(text)
    cells.add_row(Text(text))
    what = (text, Text(text), marked("[bold]{}[/] {}", text, Text(text)), cells)
    shown = printed(*what, terminal=True) + printed(*what, terminal=False)
    with contextlib.redirect_stdout(io.StringIO()) as out, guarded_streams():
        sys.stdout.write(text)
    left = OURS.sub("", shown) + out.getvalue()
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u202e]", left)


@given(HOSTILE, HOSTILE)
def test_markup_of_a_value_is_data(name: str, value: str) -> None:
    text = marked("[bold]{}[/]: {:>3}", name, value)
    assert text.plain == f"{cleaned(name)}: {cleaned(f'{value:>3}')}"
    assert {str(span.style) for span in text.spans} == ({"bold"} if name else set())


def test_a_template_takes_as_many_values_as_it_has_fields() -> None:
    with pytest.raises(ValueError, match="zip"):
        marked("{}", 1, 2)
    with pytest.raises(ValueError, match="zip"):
        marked("{} {}", 1)


@given(st.text())
def test_json_means_the_same_once_it_is_cleaned(text: str) -> None:
    plain = json.dumps(text, ensure_ascii=False)
    assert json.loads(cleaned(plain)) == text


@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
def test_what_an_encoding_lacks_is_replaced(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding, errors="strict"))
    with guarded_streams():
        Console().print(Text("█±"), "\N{SNOWMAN}")
        sys.stdout.write("█\n")
        sys.stdout.flush()
    said = raw.getvalue().decode(encoding)
    assert said.split() == ["#±" if encoding == "latin-1" else "#+-", "?", "#"]
