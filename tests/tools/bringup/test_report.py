"""The doctor's answer: rows put together, one line for all, nothing lost on a narrow terminal."""

from __future__ import annotations

import io

import msgspec
import pytest

from shared.can.drive_settings import AXES
from shared.joints import MODULES
from tools.bringup.report import Report, report_of, show, verdict_line
from tools.bringup.rows import Finding, FindingKind, merged, ok, warning, wrong
from tools.terminal import Console

FINE = [ok(f"m{i}", "supply", f"{volts:.1f} V", "8 to 60 V") for i, volts in enumerate((9.5, 48.0))]
TRAP = wrong(
    "knee_left.axis0",
    "controller.config.vel_limit",
    "2",
    "60",
    "`xrl drive configure --apply --module knee_left`",
    "it disarms",
)
NOTED = warning("robot file", "assumed", "14 [assumed]", "none", "measure them")


def printed(groups: dict[str, list[Finding]], width: int, *, verbose: bool = False) -> str:
    text = io.StringIO()
    show(Console(file=text, width=width), groups, verbose=verbose)
    return text.getvalue()


def test_rows_that_are_ok_and_alike_become_one_from_the_smallest_to_the_largest() -> None:
    (row,) = merged(FINE)
    assert (row.subject, row.found, row.wanted) == ("all 2", "9.5 V .. 48.0 V", "8 to 60 V")


def test_rows_that_are_not_ok_stay_themselves() -> None:
    assert merged([*FINE, TRAP, NOTED])[1:] == [TRAP, NOTED]


def trap(subject: str, what: str = "controller.config.vel_limit") -> Finding:
    module = subject.partition(".")[0]
    fix = f"`xrl drive configure --apply --module {module}`"
    return wrong(subject, what, "2", "60", fix, "it disarms")


def test_a_trap_of_all_twelve_axes_is_one_row_and_one_command_for_all() -> None:
    rows = [trap(f"{module}.{axis}") for module in MODULES for axis in AXES]
    (row,) = merged(rows)
    assert (row.subject, row.found, row.verdict) == ("all 12", "2", FindingKind.WRONG)
    assert row.fix == "`xrl drive configure --apply`"
    assert verdict_line({"drives": rows}) == "12 wrong: all 12 vel_limit"
    assert report_of({"drives": rows}).wrong == 12
    assert len(report_of({"drives": rows}).groups["drives"]) == 12, "machines get every row"


def test_a_trap_of_both_axes_of_one_board_is_one_row_with_its_command() -> None:
    rows = [trap("hip_left.axis0"), trap("knee_left.axis0"), trap("knee_left.axis1")]
    assert [row.subject for row in merged(rows)] == ["hip_left.axis0", "knee_left, both"]
    assert merged(rows)[1].fix.endswith("--module knee_left`")


def test_all_six_boards_are_one_row_and_five_are_not() -> None:
    rows = [trap(module, "can.config.baud_rate") for module in MODULES]
    assert [row.subject for row in merged(rows)] == ["all 6"]
    assert merged(rows[:5]) == rows[:5]


def test_values_wanted_of_one_axis_only_are_not_put_together() -> None:
    rows = [
        wrong(
            f"{module}.{axis}", "config.can.node_id", "0", str(i), "`xrl drive configure --apply`"
        )
        for i, module in enumerate(MODULES)
        for axis in AXES
    ]
    assert len(merged(rows)) == len(MODULES)


def test_a_message_of_several_services_is_shown_once() -> None:
    rows = [wrong(f"can{i}", "interface", "not there", "up", "plug it in") for i in range(7)]
    text = " ".join(printed({"computer": rows}, 100).split())
    assert text.count("plug it in") == 1
    assert "can0, can1, can2, can3, can4, can5, can6 interface: plug it in" in text


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
def test_the_last_line_is_the_answer(rows: list[Finding], line: str) -> None:
    assert verdict_line({"drives": rows}) == line
    assert " ".join(printed({"drives": rows}, 80).split()).endswith(line)


@pytest.mark.parametrize("width", [80, 109, 110, 120])
def test_name_values_reason_and_command_are_printed_whatever_the_width(width: int) -> None:
    text = " ".join(printed({"drives": [TRAP, NOTED]}, width).split())
    for words in ("knee_left.axis0", "vel_limit", "it disarms", "wrong", "warning", "14 [assumed]"):
        assert words in text
    assert "xrl drive configure" in text


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
    assert TRAP.verdict is FindingKind.WRONG
