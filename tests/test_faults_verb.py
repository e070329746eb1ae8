"""`xrl faults`: the fault table, printed."""

from __future__ import annotations

import json
from argparse import Namespace

import pytest

from shared.fault_table import DRIVE_FAULTS, LOSSES
from tools import faults


def test_every_row_is_printed_for_people_and_for_machines(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert faults.run(Namespace(json=False)) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in (*DRIVE_FAULTS, *LOSSES))
    assert faults.run(Namespace(json=True)) == 0
    table = json.loads(capsys.readouterr().out)
    assert set(table["drive"]) == set(DRIVE_FAULTS)
    assert set(table["fleet"]) == set(LOSSES)
