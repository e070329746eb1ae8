"""The report's page: one file that needs nothing else; in parts it is that of the whole."""

from __future__ import annotations

import hashlib
import itertools
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.bus import topics
from shared.bus.messages import Mode
from shared.exceptions import RunError
from shared.joints import MODULES
from tests.tools.judge.reports import runs
from tests.tools.judge.reports.runs import Made
from tools import cli
from tools.judge import verdict
from tools.judge.reports import page as page_module
from tools.judge.reports.page import POINTS, render, render_parts, thinned, with_gaps
from tools.judge.reports.run_data import RunData, Span
from tools.judge.run_parts import zero_ns
from tools.judge.verdict import summarise_parts
from tools.logs.run_index import RunIndex
from tools.logs.run_log import RunLog, RunPart, parts_of, read_part, read_run

PANELS = {
    "COM": ("x", "y"),
    "Height": ("torso", "COM"),
    "Torso angles": ("roll", "pitch", "yaw"),
    "Operator's force": ("hand, z",),
    "Modes": (),
    "Command age": MODULES,
    "Torque of each module": MODULES,
    "Certificate margin": ("joint services alone", "drives alone"),
}


def test_every_panel_has_its_data(page: str) -> None:
    data = runs.data_of(page)
    assert [panel["title"] for panel in data["panels"]] == list(PANELS)
    for title, labels in PANELS.items():
        for label in labels:
            _, values = runs.line(data, title, label)
            assert len(values) > 12, (title, label)
    assert [label for label, _ in runs.panel(data, "Modes")["rows"]] == ["planner", *MODULES]


def test_the_plots_show_the_values_of_the_log(page: str, log: RunLog) -> None:
    data = runs.data_of(page)
    zero_ns = RunData(log).zero_ns
    truth = log.messages(topics.SIM_TRUTH)
    t = (np.array([row.t_ns for row in truth]) - zero_ns) / 1e9
    x_mm = 1e3 * np.array([row.over[0] for row in truth])
    where, seen = runs.line(data, "COM", "x")
    assert (x_mm.min(), x_mm.max()) == pytest.approx((seen.min(), seen.max()), abs=1e-3)
    assert np.abs(np.interp(where, t, x_mm) - seen).max() < 0.5
    bars = dict(runs.panel(data, "Modes")["rows"])[MODULES[0]]
    for state in log.messages(topics.JOINT_STATE, MODULES[0])[::25]:
        at, mode = (state.t_ns - zero_ns) / 1e9, Mode(state.mode).name
        assert any(a - 1e-4 <= at <= b + 1e-4 and name == mode for a, b, name in bars)


def test_a_page_makes_no_network_request(page: str) -> None:
    outside = r"""(?i)(src|href|action|data)\s*=\s*["']?\s*(https?:)?//|url\(|@import|fetch\("""
    assert not re.findall(outside, page.partition('<section id="inputs"')[0])
    code = page[page.index('<script id="uplot">') :]
    banned = r"(?i)https?://\S*|XMLHttpRequest|WebSocket|import\(|fetch\("
    assert re.findall(banned, code) == ["https://github.com/leeoniya/uPlot"], "its header"
    assert "default-src 'none'" in page
    assert re.findall(r"<(?:link|img|iframe|object|embed)\b|<script src", page) == []


def test_the_verdict_is_the_sentence_that_the_command_printed(made: Made, page: str) -> None:
    sentence = re.search(r'id="verdict">([^<]+)<', page)
    assert sentence is not None
    assert sentence[1] in [line.strip() for line in made.printed.splitlines()]
    assert sentence[1].startswith("STOOD for ")
    assert 'class="caution">' not in page, "virtual time is never too slow"


def test_a_fall_and_a_machine_too_slow_are_named_with_the_verdict(log: RunLog) -> None:
    def fell(_t: float, truth: dict[str, Any]) -> None:
        truth |= {"fallen": True, "late_s": 1.5}

    about = {key: value for key, value in log.metadata["run"].items() if key != "lockstep"}
    page = render(runs.changed(log, {"sim/truth": fell}, about=about))
    assert re.search(r'<p class="verdict bad" id="verdict">FELL at \d', page)
    caution = page.partition('<p class="caution">')[2].partition("</p>")[0]
    assert "too slow for real time" in caution
    assert "1.50 s" in caution


def test_the_page_of_a_long_run_is_at_most_3_mb_and_has_every_peak(
    log: RunLog, tmp_path: Path
) -> None:
    untraced = runs.changed(log, keep=lambda name: "trace" not in name)
    long = runs.written(untraced, tmp_path, repeats=4)
    page = render(long)
    assert len(page.encode()) <= 3e6
    peak = max(abs(row.over[0]) for row in log.messages(topics.SIM_TRUTH)) * 1e3
    _, seen = runs.line(runs.data_of(page), "COM", "x")
    assert len(seen) <= 1.1 * POINTS
    assert np.nanmax(np.abs(seen)) == pytest.approx(peak, abs=1e-3)


@given(st.lists(st.floats(-1e3, 1e3) | st.just(np.nan), min_size=1, max_size=300))
def test_a_thinned_line_has_its_extremes_and_only_samples_in_their_order(
    values: list[float],
) -> None:
    t = 100.0 * np.arange(len(values))
    found_t, found = thinned(t, np.array(values), Span(0.0, 100.0 * POINTS))
    finite = [value for value in values if np.isfinite(value)]
    assert (min(found, default=0.0), max(found, default=0.0)) == (
        min(finite, default=0.0), max(finite, default=0.0),
    )  # fmt: skip
    assert (np.diff(found_t) > 0.0).all()
    assert all(values[round(at / 100.0)] == value for at, value in zip(found_t, found, strict=True))


def test_silence_breaks_a_line_and_a_missing_sample_does_not() -> None:
    t = np.concatenate((np.arange(0.0, 1.0, 0.004), np.arange(1.5, 2.0, 0.004)))
    t = np.delete(t, [50, 51])
    where, seen = with_gaps(t, np.ones(len(t)))
    assert where[np.isnan(seen)] == pytest.approx([0.997], abs=0.001)


def test_the_page_of_a_real_robot_has_its_estimates_and_says_what_is_missing(log: RunLog) -> None:
    real = runs.changed(
        log,
        keep=lambda name: not name.startswith(("sim/", "run/")),
        attachments={"robot.toml": b'name = "old"\n'},
        about={"robot": log.robot, "schema_version": log.metadata["run"]["schema_version"]},
    )
    page = render(real)
    data = runs.data_of(page)
    assert data["span"][0] == pytest.approx(0.0, abs=1e-6)
    assert "No verdict: " in page
    assert str(log.path.parent) not in page
    assert [line["label"] for line in runs.panel(data, "COM")["lines"]] == ["x", "y"]
    assert runs.panel(data, "Operator's force")["note"].startswith("By the harness sensor")
    led_by_nobody = render(runs.changed(real, keep=lambda name: name.startswith("joint/")))
    assert "no data for: COM, Height, Torso angles, Operator's force, Certificate" in led_by_nobody


@pytest.mark.parametrize("fraction", [0.3, 0.9])
def test_a_truncated_log_has_a_page_that_is_marked_so(
    made: Made, tmp_path: Path, fraction: float
) -> None:
    raw = made.path.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(raw[: round(fraction * len(raw))])
    page = render(read_run(path))
    assert "incomplete: the recorder did not close the file" in page
    assert re.search(r"lost: the last \d+ bytes, cut off", page)
    assert len(runs.line(runs.data_of(page), "Command age", MODULES[0])[0]) > 10


def test_a_log_without_messages_has_a_page(log: RunLog) -> None:
    page = render(runs.changed(log, keep=lambda name: name == "run/event"))
    assert runs.data_of(page)["panels"] == []
    assert "No verdict: " in page


def test_text_from_a_log_is_never_code_in_the_page(log: RunLog) -> None:
    def hostile(_t: float, event: dict[str, Any]) -> None:
        event["subject"] = "</script><script>alert(1)//"

    page = render(runs.changed(log, {"run/event": hostile}))
    assert "<script>alert" not in page
    assert page.count("</script>") == 3
    assert any("<script>alert" in mark[2] for mark in runs.data_of(page)["marks"])


def test_a_silent_drive_does_not_make_its_service_silent(log: RunLog, page: str) -> None:
    """The service repeats the stamp of its last sample, at first 0."""
    states = log.messages(topics.JOINT_STATE, "hip_left")
    repeated = [state for state in states if state.mode == Mode.FAULT]
    assert len({state.t_ns for state in repeated}) < len(repeated)
    bars = dict(runs.panel(runs.data_of(page), "Modes")["rows"])["hip_left"]
    assert sum(b - a for a, b, name in bars if name == "FAULT") == pytest.approx(0.8, abs=0.15)
    seen = itertools.count()

    def unset(_t: float, state: dict[str, Any]) -> None:
        if next(seen) < 25:
            state |= {"t_ns": 0, "mode": 0}

    data = runs.data_of(render(runs.changed(log, {"joint/knee_left/state": unset})))
    begin, end, name = dict(runs.panel(data, "Modes")["rows"])["knee_left"][0]
    assert name == "DISARMED"
    assert data["span"][0] <= begin
    assert end - begin == pytest.approx(25 * 0.004, abs=0.01)


def test_lost_messages_are_counted(log: RunLog, page: str) -> None:
    assert "<dt>messages lost</dt><dd>none</dd>" in page
    seen = itertools.count()

    def dropped(_t: float, wrench: dict[str, Any]) -> None:
        if next(seen) >= 100:
            wrench["seq"] += 3

    page = render(runs.changed(log, {"harness/wrench": dropped}))
    assert "<dd>3; `xrl log info` shows the topics</dd>" in page


def test_the_page_holds_the_inputs_of_the_run(page: str, log: RunLog) -> None:
    for text in (log.metadata["run"]["git_commit"], "Python", log.metadata["run"]["cpu_model"]):
        assert text in page
    assert "<summary>robot.toml</summary>" in page
    assert "<summary>scenario.toml</summary>" in page
    assert re.search(r"<td[^>]*>mujoco</td>", page)
    assert str(log.path.parent) not in page, "pages are shared"


def test_the_page_embeds_the_library_unchanged_of_the_release_that_its_note_names(
    page: str,
) -> None:
    files = (*page_module.STYLES, page_module.LIBRARY, page_module.SCRIPT)
    assert all(path.read_text(encoding="utf-8") in page for path in files)
    note = (page_module.VENDOR / "VERSION").read_text(encoding="utf-8")
    noted = {name: digest for digest, name in re.findall(r"(?m)^([0-9a-f]{64})  (\S+)$", note)}
    content = {path.name: path.read_bytes() for path in page_module.VENDOR.iterdir()}
    del content["VERSION"]
    assert noted == {name: hashlib.sha256(raw).hexdigest() for name, raw in content.items()}
    (version,) = re.findall(r"^uPlot (\S+),", note)
    assert f"(v{version})" in content["uPlot.iife.min.js"].splitlines()[0].decode()
    assert b"MIT License" in content["LICENSE"]


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
    assert 'id="verdict">Figures of a part of a run, without a verdict<' in out.read_text()
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
