"""The board that is set up otherwise than the others."""

from __future__ import annotations

import pytest

from shared.joints import MODULES
from tests.tools.bringup.board_in_memory import as_wanted, healthy
from tests.tools.bringup.verdicts import OK, bad
from tools.bringup.boards import Value
from tools.bringup.check_board import alike_rows

POLES, NAME = "axis0.motor.config.pole_pairs", "motor.config.pole_pairs"
OHM, PHASE = "axis1.motor.config.phase_resistance", "motor.config.phase_resistance"
Changes = dict[str, dict[str, Value]]


def boards(changes: Changes) -> Changes:
    return {
        module: as_wanted()
        | healthy()
        | {POLES: 7, OHM: 0.1 + 0.001 * i, "vbus_voltage": 48.0}
        | changes.get(module, {})
        for i, module in enumerate(MODULES)
    }


OWN: Changes = {
    module: {
        "axis0.config.can.node_id": 2 * i,
        "axis0.encoder.config.phase_offset": 1000 * i,
        "axis0.controller.config.vel_gain": 0.1 * i,
        "axis0.encoder.pos_estimate": 64.0 + i,
    }
    for i, module in enumerate(MODULES)
}


CASES: dict[str, tuple[Changes, list[str]]] = {
    "the one that differs": ({"knee_left": {POLES: 20}}, [f"knee_left.axis0: {NAME}: warning"]),
    "half against half": ({module: {POLES: 20} for module in MODULES[:3]}, []),
    "what belongs to one board": (OWN, []),
    "a phase within its tolerance": ({"ankle_left": {OHM: 0.125}}, []),
    "a loose phase": ({"ankle_left": {OHM: 0.2}}, [f"ankle_left.axis1: {PHASE}: warning"]),
    "another motor": ({"ankle_left": {OHM: 0.05}}, [f"ankle_left.axis1: {PHASE}: warning"]),
    "no resistance": ({"ankle_left": {OHM: 0.0}}, [f"ankle_left.axis1: {PHASE}: wrong"]),
    "one not calibrated yet": ({"ankle_left": {OHM: 0.0, "axis1.motor.is_calibrated": False}}, []),
    "a bad plug": ({"hip_left": {"vbus_voltage": 46.5}}, ["hip_left: supply: warning"]),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "expected"), CASES.values(), ids=CASES.keys())
def test_the_board_that_is_unlike_the_others_is_named(
    changes: Changes, expected: list[str]
) -> None:
    assert bad(alike_rows(boards(changes))) == expected


def test_boards_that_are_alike_are_one_row_and_two_boards_prove_nothing() -> None:
    (row,) = alike_rows(boards({}))
    assert (row.verdict, row.subject) == (OK, "all 6")
    assert alike_rows(dict(list(boards({}).items())[:2])) == []


def test_the_row_has_what_the_others_have() -> None:
    (row,) = alike_rows(boards({"knee_left": {POLES: 20}}))
    assert (row.found, row.wanted) == ("20", "7, as 5 others")


def test_a_setting_that_one_board_lacks_shows() -> None:
    six = boards({})
    del six["hip_right"][POLES]
    assert bad(alike_rows(six)) == [f"hip_right.axis0: {NAME}: warning"]
