"""The doctor's answer: rows put together, one line for all, nothing lost on a narrow terminal."""

from __future__ import annotations

import io

import msgspec
import pytest

from shared.can.drive_settings import AXES
from shared.joints import MODULES
from tools.bringup.findings import (
    Finding,
    FindingKind,
    Report,
    merged,
    ok,
    report_of,
    show,
    verdict_line,
    warning,
    wrong,
)
from tools.terminal import Console

ALL_AXES = [f"{module}.{axis}" for module in MODULES for axis in AXES]
FINE = [ok(f"m{i}", "supply", f"{volts:.1f} V", "8 to 60 V") for i, volts in enumerate((9.5, 48.0))]
NOTED = warning("robot file", "assumed", "14 [assumed]", "none", "measure them")


def trap(subject: str, what: str = "controller.config.vel_limit", wanted: str = "60") -> Finding:
    fix = f"`xrl drive configure --apply --module {subject.partition('.')[0]}`"
    return wrong(subject, what, "2", wanted, fix, "it disarms")


TRAP = trap("knee_left.axis0")
MANY = [trap(f"bus{i}", "speed") for i in range(8)]


def printed(groups: dict[str, list[Finding]], width: int, *, verbose: bool = False) -> str:
    text = io.StringIO()
    show(Console(file=text, width=width), groups, verbose=verbose)
    return " ".join(text.getvalue().split())


def test_rows_that_are_ok_and_alike_become_one_and_others_stay_themselves() -> None:
    row, *others = merged([*FINE, TRAP, NOTED])
    assert (row.subject, row.found, row.wanted) == ("all 2", "9.5 V .. 48.0 V", "8 to 60 V")
    assert others == [TRAP, NOTED]


@pytest.mark.parametrize(
    ("rows", "subjects", "fix"),
    [
        pytest.param([trap(axis) for axis in ALL_AXES], ["all 12"], "--apply`",
                     id="all twelve axes: one command for all"),
        pytest.param([trap("hip_left.axis0"), trap("knee_left.axis0"), trap("knee_left.axis1")],
                     ["hip_left.axis0", "knee_left, both"], "--module knee_left`",
                     id="both axes of one board: its command"),
        pytest.param([trap(module, "can.config.baud_rate") for module in MODULES], ["all 6"],
                     "--apply`", id="all six boards"),
        pytest.param([trap(module) for module in MODULES[:5]], list(MODULES[:5]),
                     f"--module {MODULES[4]}`", id="five are not all"),
        pytest.param([trap(axis, wanted=axis.partition(".")[0]) for axis in ALL_AXES],
                     [f"{module}, both" for module in MODULES], f"--module {MODULES[5]}`",
                     id="values wanted of one module only are not put together"),
    ],
)  # fmt: skip
def test_rows_of_one_matter_are_as_few_as_can_stand_for_it(
    rows: list[Finding], subjects: list[str], fix: str
) -> None:
    assert [row.subject for row in merged(rows)] == subjects
    assert merged(rows)[-1].fix.endswith(fix)
    assert {(row.found, row.verdict) for row in merged(rows)} == {("2", FindingKind.WRONG)}
    assert len(report_of({"drives": rows}).groups["drives"]) == len(rows), "machines get every row"


def test_a_message_of_several_services_is_shown_once() -> None:
    rows = [wrong(f"can{i}", "interface", "not there", "up", "plug it in") for i in range(7)]
    text = printed({"computer": rows}, 100)
    assert text.count("plug it in") == 1
    assert "can0, can1, can2, can3, can4, can5, can6 interface: plug it in" in text


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        (FINE, "all ok"),
        ([*FINE, NOTED], "nothing wrong; 1 warning: robot file assumed"),
        ([TRAP], "1 wrong: knee_left.axis0 vel_limit"),
        ([TRAP, NOTED], "1 wrong: knee_left.axis0 vel_limit; 1 warning: robot file assumed"),
        (MANY, "8 wrong: " + ", ".join(f"bus{i} speed" for i in range(6)) + " and 2 more"),
        ([trap(axis) for axis in ALL_AXES], "12 wrong: all 12 vel_limit"),
    ],
)
def test_the_last_line_is_the_answer(rows: list[Finding], line: str) -> None:
    assert verdict_line({"drives": rows}) == line
    assert printed({"drives": rows}, 80).endswith(line)


@pytest.mark.parametrize("width", [80, 109, 110, 120])
def test_name_values_reason_and_command_are_printed_whatever_the_width(width: int) -> None:
    text = printed({"drives": [TRAP, NOTED]}, width)
    for words in ("knee_left.axis0", "vel_limit", "it disarms", "wrong", "warning", "14 [assumed]"):
        assert words in text
    assert "xrl drive configure" in text


def test_in_a_pipe_a_note_is_not_padded_to_its_width() -> None:
    """`xrl doctor | cat` wrote lines of 10 000 columns."""
    text = io.StringIO()
    show(Console(file=text), {"drives": [TRAP]}, verbose=False)
    lines = text.getvalue().splitlines()
    assert any(line.endswith("it disarms") for line in lines)
    assert max(map(len, lines)) < 200


def test_verbose_prints_every_row() -> None:
    text = printed({"drives": FINE}, 80, verbose=True)
    assert ("m0" in text, "m1" in text, "all 2" in text) == (True, True, False)


def test_the_report_counts_and_reads_back_from_its_json() -> None:
    report = report_of({"drives": [*FINE, TRAP, NOTED]})
    assert (report.ok, report.wrong, report.warnings) == (False, 1, 1)
    assert msgspec.json.decode(msgspec.json.encode(report), type=Report) == report
    assert report_of({"drives": [*FINE, NOTED]}).ok
