from __future__ import annotations

import hashlib
import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tools.judge.reports.timeline import timeline_events
from tools.judge.reports.torques import torque_terms

from shared.bus import topics
from shared.bus.messages import JointState, Mode
from shared.joints import JOINTS, MODULES
from tests.tools.judge.reports import runs
from tests.tools.judge.reports.runs import Made
from tools.judge.reports import page as page_module
from tools.judge.reports import panels
from tools.judge.reports.page import render
from tools.judge.reports.run_data import RunData
from tools.logs.run_log import RunLog, read_run

PLOTS = {
    "COM": ("x", "y"),
    "Height": ("torso", "COM"),
    "Torso angles": ("roll", "pitch", "yaw"),
    "Operator's force": ("hand, z",),
    "Tilt of the soles": ("right", "left"),
    "Slip of the feet": ("larger of both ankles",),
    "Difference between the legs, position": ("x", "y", "z"),
    "Difference between the legs, angle": ("roll", "pitch", "yaw"),
    "Certificate margin": ("joint services alone", "drives alone"),
    "Torque of each module against its limit": MODULES,
    "Harness force": ("x", "y", "z"),
    "Harness moment": ("x", "y", "z"),
    "Command age": MODULES,
    "Control cycles of each service": MODULES,
    "Messages recorded": ("joint/state, slowest module", "planner/status", "sim/truth"),
}
BARS = (
    "Modes of the six services", "Drives", "Planner", "Source of the local gains",
    "Harness sensor",
)  # fmt: skip
ORIGINS = {
    "total, after the torque limiter", "tau_ff", "tau_coupled", "local PD",
    "removed by the service",
}  # fmt: skip


def test_every_panel_has_its_data(page: str, log: RunLog) -> None:
    data = runs.data_of(page)
    for title, labels in PLOTS.items():
        for label in labels:
            _, values = runs.line(data, title, label)
            assert len(values) > 12, (title, label)
    for title in BARS:
        assert all(row["spans"] for row in runs.panel(data, title)["rows"])
    for title, least in (
        ("Torque of one joint, by origin", ORIGINS),
        ("Angle of one joint", {"q", "q_ref"}),
        ("Rate of one joint", {"v", "v_ref"}),
    ):
        choices = runs.panel(data, title)["choices"]
        assert [choice["label"] for choice in choices] == list(JOINTS)
        for choice in choices:
            assert least <= {line["label"] for line in choice["lines"]}


def test_the_plots_show_the_values_of_the_log(page: str, log: RunLog) -> None:
    data = runs.data_of(page)
    zero_ns = RunData(log).zero_ns
    truth = log.messages(topics.SIM_TRUTH)
    t = (np.array([row.t_ns for row in truth]) - zero_ns) / 1e9
    x_mm = 1e3 * np.array([row.com[0] for row in truth])
    where, seen = runs.line(data, "COM", "x")
    assert (x_mm.min(), x_mm.max()) == pytest.approx((seen.min(), seen.max()), abs=1e-3)
    assert np.abs(np.interp(where, t, x_mm) - seen).max() < 0.5
    spans = runs.panel(data, "Modes of the six services")["rows"][0]["spans"]
    states = log.messages(topics.JOINT_STATE, MODULES[0])
    for state in states[::25]:
        at = (state.t_ns - zero_ns) / 1e9
        assert any(a - 1e-4 <= at <= b + 1e-4 and code == state.mode for a, b, code in spans)


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


def test_a_fall_has_the_verdict_of_the_commands(log: RunLog) -> None:
    def fell(_t: float, truth: dict[str, Any]) -> None:
        truth["fallen"] = True

    page = render(runs.changed(log, {"sim/truth": fell}))
    assert re.search(r'<p class="verdict bad" id="verdict">FELL at \d', page)


def test_the_page_of_a_long_run_is_at_most_5_mb(log: RunLog, tmp_path: Path) -> None:
    """Its bins are full from 9 s on: only the timeline grows."""
    untraced = runs.changed(log, keep=lambda name: "trace" not in name)
    long = runs.written(untraced, tmp_path, repeats=4)
    begin, end = RunData(long).span
    assert end - begin > 24.0
    page = render(long)
    assert len(page.encode()) <= 4.9e6
    peak = max(abs(row.com[0]) for row in log.messages(topics.SIM_TRUTH)) * 1e3
    _, seen = runs.line(runs.data_of(page), "COM", "x")
    assert np.nanmax(np.abs(seen)) == pytest.approx(peak, abs=1e-3)


def test_the_page_of_a_real_robot_lists_what_is_missing(log: RunLog) -> None:
    real = runs.changed(
        log,
        keep=lambda name: not name.startswith(("sim/", "run/")),
        attachments={"robot.toml": log.attachments["robot.toml"]},
        about={"robot": log.robot, "schema_version": log.metadata["run"]["schema_version"]},
    )
    page = render(real)
    data = runs.data_of(page)
    assert data["span"][0] == pytest.approx(0.0, abs=1e-6)
    assert "No verdict: " in page
    assert "<li>Operator&#x27;s force: no sim/truth in this log</li>" in page
    assert len(runs.line(data, "COM", "x")[0]) > 50, (
        "the planner's estimate replaces the simulated value"
    )
    assert "Tilt of the soles" not in [panel["title"] for panel in data["panels"]]


def test_a_log_with_an_unreadable_robot_file_has_a_page_without_origins(log: RunLog) -> None:
    foreign = runs.changed(log, attachments={"robot.toml": b'name = "old"\n'})
    data = runs.data_of(render(foreign))
    choice = runs.panel(data, "Torque of one joint, by origin")
    assert "Origins unknown: " in choice["note"]
    assert str(log.path.parent) not in choice["note"]
    assert {line["label"] for line in choice["choices"][0]["lines"]} == {
        "total, after the torque limiter",
        "total of theta",
    }


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
    data = runs.data_of(page)
    assert data["panels"] == [] or all(panel["kind"] == "plot" for panel in data["panels"])
    assert "No verdict: " in page


def test_text_from_a_log_is_never_code_in_the_page(log: RunLog) -> None:
    def hostile(_t: float, event: dict[str, Any]) -> None:
        event["subject"] = "</script><script>alert(1)//"

    page = render(runs.changed(log, {"run/event": hostile}))
    assert "<script>alert" not in page
    assert page.count("</script>") == 3
    assert any("<script>alert" in mark[2] for mark in runs.data_of(page)["marks"])


def test_the_origins_of_a_torque_add_up_to_it(log: RunLog) -> None:
    """Except for the part that the torque limiter cuts."""
    run = RunData(log)
    assert run.robot is not None
    most = run.robot.joint.tau_module_max
    for module in MODULES:
        states: list[JointState] = log.messages(topics.JOINT_STATE, module)
        found = torque_terms(run, run.robot, module)
        total = found.feedforward + found.coupled + found.local
        known = np.isfinite(total[:, 0])
        tracking = np.array([state.mode == Mode.TRACK for state in states])
        assert (known <= tracking).all()
        assert known.sum() > 0.5 * tracking.sum() > 100
        sent = np.array([state.tau for state in states])
        assert np.abs(total + found.removed - sent)[known].max() < 1e-9
        off = np.abs(found.removed)[known]
        cut = np.abs(sent[known]).sum(axis=1) > 0.999 * most
        assert (cut | (off < 1e-9).all(axis=1)).all()


def test_the_timeline_has_the_kill_the_hold_and_the_recovery(log: RunLog) -> None:
    rows = timeline_events(RunData(log))
    assert [row.t for row in rows] == sorted(row.t for row in rows)
    texts = [row.text for row in rows]
    kill = next(row for row in rows if row.kind == "kill")
    assert (kill.mark, kill.t) == ("planner KILL", pytest.approx(1.0, abs=0.01))
    hold = next(row for row in rows if "TRACK to HOLD, PLANNER_ENDED" in row.text)
    assert hold.text.startswith("all six: ")
    assert 0.0 < hold.t - kill.t < 0.065
    silence = next(text for text in texts if "silent for up to 0." in text)
    assert {"joint/*/command", "planner/status"} <= set(silence.replace(",", "").split())
    assert not any("state silent" in text for text in texts), (
        "its drive was silent, the service was not"
    )
    assert any(text.startswith("hip_left: drive ARMED to ") for text in texts)
    assert {row.kind for row in rows if row.mark} == {"kill", "restart", "push", "fault"}
    again = [text for text in texts if "HOLD to TRACK, COMMANDS_FRESH" in text]
    assert len(again) >= 2, "at the start and after the restart"


def test_a_silent_drive_does_not_make_its_service_silent(log: RunLog, page: str) -> None:
    """The service repeats the stamp of its last sample."""
    states = log.messages(topics.JOINT_STATE, "hip_left")
    repeated = [state for state in states if state.mode == Mode.FAULT]
    assert len({state.t_ns for state in repeated}) < len(repeated)
    row = runs.panel(runs.data_of(page), "Modes of the six services")["rows"][-1]
    fault = sum(b - a for a, b, code in row["spans"] if code == Mode.FAULT)
    assert fault == pytest.approx(4.0 - 3.2, abs=0.15)


def test_a_state_before_the_first_sample_is_placed_at_its_reception(log: RunLog) -> None:
    seen = itertools.count()

    def unset(_t: float, state: dict[str, Any]) -> None:
        if next(seen) < 25:
            state |= {"t_ns": 0, "mode": 0}

    data = runs.drawn(runs.changed(log, {"joint/knee_left/state": unset}), panels.states)
    row = runs.panel(data, "Modes of the six services")["rows"][MODULES.index("knee_left")]
    begin, end, mode = row["spans"][0]
    assert mode == Mode.DISARMED
    assert data["span"][0] <= begin < end
    assert end - begin == pytest.approx(25 * 0.004, abs=0.01)


def test_lost_messages_are_counted_by_topic(log: RunLog, page: str) -> None:
    assert "Messages: none lost" in page
    seen = itertools.count()

    def dropped(_t: float, wrench: dict[str, Any]) -> None:
        if next(seen) >= 100:
            wrench["seq"] += 3

    page = render(runs.changed(log, {"harness/wrench": dropped}))
    assert "Messages: 3 lost on the way to the log" in page
    assert re.search(r"harness/wrench</td>(<td[^>]*>[^<]*</td>){3}<td[^>]*>3</td>", page)


def test_the_page_holds_the_inputs_of_the_run(page: str, log: RunLog) -> None:
    for text in (log.metadata["run"]["git_commit"], "Python", log.metadata["run"]["cpu_model"]):
        assert text in page
    assert "<summary>robot.toml</summary>" in page
    assert "<summary>scenario.toml</summary>" in page
    assert "<td>mujoco</td>" in page
    assert str(log.path.parent) not in page, "pages are shared"


def test_the_page_embeds_the_library_unchanged_and_all_scripts(page: str) -> None:
    files = (*page_module.STYLES, page_module.LIBRARY, *page_module.SCRIPTS)
    assert all(path.read_text(encoding="utf-8") in page for path in files)
    unused = set(page_module.HERE.glob("*.js")) - set(page_module.SCRIPTS)
    assert unused == set()


def test_the_library_is_the_release_that_its_note_names() -> None:
    note = (page_module.VENDOR / "VERSION").read_text(encoding="utf-8")
    noted = {name: digest for digest, name in re.findall(r"(?m)^([0-9a-f]{64})  (\S+)$", note)}
    files = {path.name: path.read_bytes() for path in page_module.VENDOR.iterdir()}
    del files["VERSION"]
    assert noted == {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    (version,) = re.findall(r"^uPlot (\S+),", note)
    header = files["uPlot.iife.min.js"].splitlines()[0].decode()
    assert f"(v{version})" in header
    assert b"MIT License" in files["LICENSE"]
