"""`xrl study sweep latency` in words and in pictures, of tables that are made up."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest

from tools.lab.studies.sweeps import latency_picture, latency_report
from tools.lab.studies.sweeps.table import Row
from tools.terminal import Console


def made_up(fell: Callable[[str, float, float], bool]) -> list[Row]:
    """Return rows of a whole grid, two trials each."""
    columns = ("operator_peak_n", "hold_share", "com_max_mm", "torque_step_nm", "hold_step_nm")
    grid = product(("centralised", "distributed"), (0.0, 50.0), (0.0, 0.5), range(2))
    return [
        {
            "number": str(number),
            "control": control,
            "delay_ms": f"{delay:g}",
            "jitter_ms": "0",
            "loss": f"{loss:g}",
            "ending": "fell" if fell(control, delay, loss) else "stood",
            **dict.fromkeys(columns, str(10 + number)),
        }
        for number, (control, delay, loss, _) in enumerate(grid)
    ]


def test_falls_are_counted_where_they_were(capsys: pytest.CaptureFixture[str]) -> None:
    rows = made_up(lambda control, delay, _loss: control == "centralised" and delay == 50.0)
    assert latency_report.controls_in(rows) == ["distributed", "centralised"]
    own = latency_report.chosen(rows, "centralised", delay_ms=50.0)
    assert latency_report.falls(own) == (4, 4)
    assert latency_report.falls(latency_report.chosen(rows, "centralised")) == (4, 8)
    assert latency_report.falls(own).bounds[0] > 0.3
    assert {row["loss"] for row in latency_report.without_loss(rows)} == {"0"}
    latency_report.show(rows, "xrl study sweep latency", Console(width=120))
    output = capsys.readouterr().out
    assert "centralised: 4 of 8 fell; most at 50 ms, 4 of 4" in output
    assert "distributed: none of 8 fell" in output
    assert "xrl study sweep latency --only 4" in output


def test_each_delay_has_bounds_of_its_own_and_names_their_mix(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The worst of several delays is chosen: 95 % of it would be 83 %."""
    rows = made_up(lambda control, delay, _loss: control == "centralised" and delay == 50.0)
    latency_report.show(rows, "xrl study sweep latency", Console(width=80))
    table, _, rest = capsys.readouterr().out.partition("Hand's peak force")
    assert "in this mix: 0, 50 % lost" in " ".join(table.split())
    assert [" ".join(line.split()) for line in table.splitlines() if " of 4" in line] == [
        "0 0 of 4 0-49 % 0 of 4 0-49 %",
        "50 0 of 4 0-49 % 4 of 4 51-100 %",
    ]
    assert "Wilson" not in rest
    both = [{**row, "jitter_ms": jitter} for row in rows for jitter in ("0", "5")]
    assert latency_report.mix(both) == "0, 50 % lost, 0, 5 ms of jitter"


def test_a_study_with_trials_missing_reports_how_many_there_are() -> None:
    rows = made_up(lambda *_: False)
    assert latency_picture._each(rows) == "4 trials a point"
    assert latency_picture._each(rows[:-1]) == "3 to 4 trials a point"


def test_pictures_are_drawn_of_what_there_is(tmp_path: Path) -> None:
    """A study that was stopped early, and one in which everything fell at once."""
    rows = made_up(lambda *_: True)
    short = [{**row, "operator_peak_n": "", "hold_share": ""} for row in rows[:3]]
    for name, some in (("all", rows), ("few", short)):
        folder = tmp_path / name
        folder.mkdir()
        for path in latency_picture.draw(some, 150.0, "made up", folder):
            assert 10_000 < path.stat().st_size < 150_000
