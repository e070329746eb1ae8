"""A run that is read in parts has the page and the verdict of the whole."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from shared.bus import topics
from shared.exceptions import RunError
from tests.tools.judge.reports import runs
from tests.tools.judge.reports.runs import Made
from tools import cli
from tools.judge import verdict
from tools.judge.reports.page import render, render_parts
from tools.judge.run_parts import zero_ns
from tools.judge.verdict import summarise_parts
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, RunPart, parts_of, read_part

PART_S = 0.9


@pytest.fixture(scope="module")
def in_parts(log: RunLog) -> str:
    return render_parts(log.index, part_s=PART_S)


def section(page: str, name: str) -> list[str]:
    found = re.search(rf'<section id="{name}">(.*?)</section>', page, re.S)
    assert found is not None
    return re.findall(r"<(?:span|td)[^>]*>([^<]+)<", found[1])


def test_the_sentence_of_the_verdict_is_that_of_the_whole(page: str, in_parts: str) -> None:
    whole, parts = (re.search(r'id="verdict">([^<]+)<', one) for one in (page, in_parts))
    assert whole is not None
    assert parts is not None
    assert parts[1] == whole[1]


def test_the_timeline_is_that_of_the_whole(page: str, in_parts: str) -> None:
    assert len(section(page, "timeline")) > 10
    whole, parts = (
        [re.sub(r"[\d.]+ s in total", "", row) for row in section(one, "timeline")]
        for one in (page, in_parts)
    )
    assert parts == whole


def test_panels_and_lines_are_those_of_the_whole(page: str, in_parts: str) -> None:
    whole, parts = runs.data_of(page), runs.data_of(in_parts)
    assert [panel["title"] for panel in parts["panels"]] == [
        panel["title"] for panel in whole["panels"]
    ]
    for title, label in (("COM", "x"), ("Height", "torso"), ("Command age", "knee_left")):
        (t, values), (t_all, values_all) = (
            runs.line(data, title, label) for data in (parts, whole)
        )
        # at a scale of hours a bin's extremes are shown; every one of them is kept
        assert np.nanmin(values) == pytest.approx(np.nanmin(values_all), abs=1e-3)
        assert np.nanmax(values) == pytest.approx(np.nanmax(values_all), abs=1e-3)
        assert (t[0], t[-1]) == pytest.approx((t_all[0], t_all[-1]), abs=0.01)


def test_the_bars_are_those_of_the_whole(page: str, in_parts: str) -> None:
    whole, parts = (runs.panel(runs.data_of(one), "Modes")["rows"] for one in (page, in_parts))
    for (label, row), (label_all, row_all) in zip(parts, whole, strict=True):
        assert label == label_all
        assert [bar[2] for bar in row] == [bar[2] for bar in row_all]
        edges, edges_all = (np.array([bar[:2] for bar in one]) for one in (row, row_all))
        np.testing.assert_allclose(edges, edges_all, atol=0.005)


def test_the_verdict_is_that_of_the_whole(log: RunLog, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tools.judge.verdict.parts_of", partial(parts_of, part_s=PART_S))
    duration_s = 6.0
    whole, parts = verdict.summarise(log, duration_s), summarise_parts(log.index, duration_s)
    for key in (
        "stood", "why_not", "hold_entries", "handover_ms", "reengage_s", "links_impaired",
        "messages_recorded", "sequence_gaps",
    ):  # fmt: skip
        assert getattr(parts, key) == getattr(whole, key), key
    for key in ("operator_peak_n", "alive_com_x_max_mm", "hold_com_x_max_mm", "torso_height_min_m"):
        assert getattr(parts, key) == pytest.approx(getattr(whole, key)), key


def test_a_part_before_the_scenario_is_no_reason_not_to_judge_the_run(log: RunLog) -> None:
    found = summarise_parts(log.index, 1.0)
    assert found.stood


def test_a_part_of_a_run_has_the_time_of_the_whole_and_all_events(
    made: Made, log: RunLog, tmp_path: Path
) -> None:
    out = tmp_path / "part.html"
    words = ["--from", "1", "--to", "2", "-o", str(out), "--open", "no"]
    assert cli.main(["log", "report", str(made.path), *words]) == 0
    assert 'id="verdict">A part of a run, and its figures: no verdict<' in out.read_text()
    data = runs.data_of(out.read_text())
    assert data["span"] == pytest.approx([1.0, 2.0], abs=1e-6)
    t, values = runs.line(data, "COM", "x")
    assert t[0] >= 1.0
    assert t[-1] <= 2.001
    assert np.isfinite(values).any()


def test_a_run_too_long_to_be_read_at_once_says_what_to_give(
    log: RunLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tools.logs.run_log.WHOLE_MAX_S", 1.0)
    with pytest.raises(RunError, match="--from and --to"):
        read_part(log.index, RunPart())
    assert read_part(log.index, RunPart(0.5, 1.2)).keys()


def test_events_are_in_every_part_and_all_other_messages_in_one(log: RunLog) -> None:
    index = RunIndex(log.path)
    counts: dict[str, int] = {}
    for part in parts_of(index, part_s=PART_S, margin_s=0.0):
        for key in part.keys():  # noqa: SIM118 - a log is no mapping
            counts[key] = counts.get(key, 0) + part.count(key)
            if key.endswith("/event"):
                assert part.count(key) == log.count(key)
    periodic = [key for key in log.keys() if not key.endswith("/event")]  # noqa: SIM118
    assert {key: counts[key] for key in periodic if counts[key] != log.count(key)} == {}


def test_time_zero_is_that_of_the_scenario(log: RunLog) -> None:
    assert zero_ns(log.index) == verdict.course(log).zero_ns


def test_a_change_across_a_silence_at_the_edge_of_a_part_has_its_row(
    log: RunLog, tmp_path: Path
) -> None:
    """The planner is dead for longer than a part and its margins."""
    dead = {topics.PLANNER_STATUS.name: lambda t, _: not 1.0 <= t < 5.0}
    quiet = runs.written(runs.changed(log, dead), tmp_path)
    whole, parts = (
        [row for row in section(page, "timeline") if "planner: " in row]
        for page in (render(quiet), render_parts(quiet.index, part_s=PART_S))
    )
    assert whole
    assert parts == whole
