"""The doctor's answer: rows put together, one line for all, nothing lost on a narrow terminal."""

from __future__ import annotations

import io

import msgspec
import pytest
from rich.console import Console

from tools.bringup.report import Report, report_of, show, verdict_line
from tools.bringup.rows import Row, Verdict, merged, ok, warning, wrong

FINE = [ok(f"m{i}", "supply", f"{volts:.1f} V", "8 to 60 V") for i, volts in enumerate((9.5, 48.0))]
TRAP = wrong(
    "knee_left.axis0",
    "controller.config.vel_limit",
    "2",
    "60",
    "`xrl configure --apply --module knee_left`",
    "it disarms",
)
NOTED = warning("robot file", "assumed", "14 [assumed]", "none", "measure them")


def printed(groups: dict[str, list[Row]], width: int, *, verbose: bool = False) -> str:
    text = io.StringIO()
    show(Console(file=text, width=width), groups, verbose=verbose)
    return text.getvalue()


def test_rows_that_are_ok_and_alike_become_one_from_the_smallest_to_the_largest() -> None:
    (row,) = merged(FINE)
    assert (row.subject, row.found, row.wanted) == ("all 2", "9.5 V .. 48.0 V", "8 to 60 V")


def test_rows_that_are_not_ok_stay_themselves() -> None:
    assert merged([*FINE, TRAP, NOTED])[1:] == [TRAP, NOTED]


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        (FINE, "all ok"),
        ([*FINE, NOTED], "nothing wrong; 1 warning: robot file assumed"),
        ([TRAP], "1 wrong: knee_left.axis0 vel_limit"),
        (
            [TRAP, NOTED],
            "1 wrong: knee_left.axis0 vel_limit; 1 warning: robot file assumed",
        ),
        ([TRAP] * 8, "8 wrong: " + ", ".join(["knee_left.axis0 vel_limit"] * 6) + " and 2 more"),
    ],
)
def test_the_last_line_is_the_answer(rows: list[Row], line: str) -> None:
    assert verdict_line({"drives": rows}) == line
    assert " ".join(printed({"drives": rows}, 80).split()).endswith(line)


@pytest.mark.parametrize("width", [80, 109, 110, 120])
def test_name_values_reason_and_command_are_printed_whatever_the_width(width: int) -> None:
    text = " ".join(printed({"drives": [TRAP, NOTED]}, width).split())
    for words in ("knee_left.axis0", "vel_limit", "it disarms", "wrong", "warning", "14 [assumed]"):
        assert words in text
    assert "xrl configure" in text


def test_verbose_prints_every_row() -> None:
    text = printed({"drives": FINE}, 80, verbose=True)
    assert "m0" in text
    assert "m1" in text
    assert "all 2" not in text


def test_the_report_counts_and_reads_back_from_its_json() -> None:
    report = report_of({"drives": [*FINE, TRAP, NOTED]})
    assert (report.ok, report.wrong, report.warnings) == (False, 1, 1)
    assert msgspec.json.decode(msgspec.json.encode(report), type=Report) == report
    assert report_of({"drives": [*FINE, NOTED]}).ok
    assert TRAP.verdict is Verdict.WRONG
