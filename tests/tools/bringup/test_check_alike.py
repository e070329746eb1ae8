"""The board that is set up otherwise than the others."""

from __future__ import annotations

import pytest

from shared.joints import MODULES
from tests.tools.bringup.board_in_memory import as_wanted, healthy
from tools.bringup.boards import Value
from tools.bringup.check_alike import alike_rows
from tools.bringup.findings import Finding, FindingKind

POLES = "axis0.motor.config.pole_pairs"
RESISTANCE = "axis1.motor.config.phase_resistance"


def boards() -> dict[str, dict[str, Value]]:
    return {
        module: as_wanted() | healthy() | {POLES: 7, RESISTANCE: 0.1 + 0.001 * i}
        for i, module in enumerate(MODULES)
    }


def bad(rows: list[Finding]) -> list[tuple[str, str, FindingKind]]:
    return [(row.subject, row.what, row.verdict) for row in rows if row.verdict != FindingKind.OK]


def test_boards_that_are_alike_are_one_row() -> None:
    (row,) = alike_rows(boards())
    assert (row.verdict, row.subject) == (FindingKind.OK, "all 6")


def test_the_one_that_differs_is_named_with_what_the_others_have() -> None:
    six = boards()
    six["knee_left"][POLES] = 20
    (row,) = alike_rows(six)
    assert (row.subject, row.what) == ("knee_left.axis0", "motor.config.pole_pairs")
    assert (row.verdict, row.found, row.wanted) == (FindingKind.WARNING, "20", "7, as 5 others")


def test_a_setting_that_one_board_lacks_shows() -> None:
    six = boards()
    del six["hip_right"][POLES]
    assert bad(alike_rows(six)) == [
        ("hip_right.axis0", "motor.config.pole_pairs", FindingKind.WARNING)
    ]


def test_half_against_half_accuses_no_module() -> None:
    six = boards()
    for module in MODULES[:3]:
        six[module][POLES] = 20
    assert bad(alike_rows(six)) == []


def test_two_boards_prove_nothing() -> None:
    assert alike_rows(dict(list(boards().items())[:2])) == []


def test_what_belongs_to_one_board_may_differ() -> None:
    six = boards()
    for i, values in enumerate(six.values()):
        values |= {
            "axis0.config.can.node_id": 2 * i,
            "axis0.encoder.config.phase_offset": 1000 * i,
            "axis0.controller.config.vel_gain": 0.1 * i,
            "axis0.encoder.pos_estimate": 64.0 + i,
        }
    assert bad(alike_rows(six)) == []


@pytest.mark.parametrize(
    ("ohm", "expected"),
    [
        (0.125, []),
        (0.2, [FindingKind.WARNING]),
        (0.05, [FindingKind.WARNING]),
        (0.0, [FindingKind.WRONG]),
    ],
)
def test_a_phase_resistance_unlike_the_others_is_a_loose_phase_or_another_motor(
    ohm: float, expected: list[FindingKind]
) -> None:
    six = boards()
    six["ankle_left"][RESISTANCE] = ohm
    assert [row.verdict for row in alike_rows(six) if row.verdict != FindingKind.OK] == expected


def test_a_motor_that_is_not_calibrated_has_no_resistance_yet() -> None:
    six = boards()
    six["ankle_left"] |= {RESISTANCE: 0.0, "axis1.motor.is_calibrated": False}
    assert bad(alike_rows(six)) == []


def test_a_supply_lower_than_the_others_is_a_bad_plug() -> None:
    six = boards()
    six["hip_left"]["vbus_voltage"] = 46.5
    assert bad(alike_rows(six)) == [("hip_left", "supply", FindingKind.WARNING)]
