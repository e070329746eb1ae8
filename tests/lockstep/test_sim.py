"""`xrl sim`: the verb around lockstep."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shared.bus import topics
from shared.bus.messages import PlannerStatus
from shared.clock import NS_PER_S
from shared.joints import MODULES
from tools import cli
from tools.logs.run_log import read_run
from tools.sim import lockstep

NOT_HERE = (topics.ATTITUDE, topics.OPERATOR_INTENT, topics.TOOLS)
"""Periodic topics that a run in virtual time does not have: no IMU is fitted, the scenario requests
without a message, and no tool links."""


def sim(out: Path, *flags: str) -> int:
    return cli.main(["sim", "--out", str(out), *flags])


def test_a_run_is_recorded_judged_and_drawn(tmp_path: Path) -> None:
    flags = ("--duration", "3", "--kill", "planner@1", "--restart", "planner@1.6")
    assert sim(tmp_path, *flags) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["stood"] is True
    assert summary["reengage_s"] < 1.5
    assert max(summary["handover_ms"].values()) <= 55.0
    assert (tmp_path / "run.png").stat().st_size > 20_000
    log = read_run(tmp_path / "run.mcap")
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    assert len({status.session for status in statuses}) == 2
    lacking = {
        topic.name
        for topic in topics.TOPICS
        if topic.recorded and topic.rate_hz > 0.0 and topic not in NOT_HERE
        if not log.count(topic.key(log.robot, MODULES[0] if topic.per_module else ""))
    }
    assert lacking == set(), "publish it in tools/sim/virtual_*.py as the service does live"


def test_a_frozen_planner_goes_on_in_its_session(tmp_path: Path) -> None:
    flags = ("--duration", "3", "--kill", "planner@1:STOP", "--restart", "planner@1.6")
    assert sim(tmp_path, *flags) == 0
    log = read_run(tmp_path / "run.mcap")
    statuses: list[PlannerStatus] = log.messages(topics.PLANNER_STATUS)
    assert len({status.session for status in statuses}) == 1
    assert json.loads((tmp_path / "summary.json").read_text())["reengage_s"] < 1.5


def test_the_same_seed_gives_the_same_log(tmp_path: Path) -> None:
    flags = ("--duration", "1", "--jitter", "3", "--delay", "3", "--loss", "0.2", "--kill",
             "planner@0.9", "--seed")  # fmt: skip
    for name, seed in (("a", "5"), ("b", "5"), ("c", "6")):
        assert sim(tmp_path / name, *flags, seed) == 0
    states = [
        read_run(tmp_path / name / "run.mcap").messages(topics.JOINT_STATE, "knee_left")
        for name in "abc"
    ]
    assert states[0] == states[1]
    assert states[0] != states[2]


def test_a_lean_that_was_asked_for_is_not_judged_as_an_excursion_and_comes_out_again(
    tmp_path: Path,
) -> None:
    """`xrl log resim` hears what was asked from the record."""
    assert sim(tmp_path, "--scenario", "shift", "--duration", "2.5", "--kill", "planner@2.4") == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["com_y_max_mm"] > 35.0
    assert summary["alive_com_y_max_mm"] < 10.0
    statuses: list[PlannerStatus] = read_run(tmp_path / "run.mcap").messages(topics.PLANNER_STATUS)
    assert max(status.shift_requested[1] for status in statuses) == pytest.approx(0.04, abs=1e-4)
    assert cli.main(["log", "resim", str(tmp_path), "--service", "planner"]) == 0


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--loss", "1.5"), "from 0 to 1"),
        (("--delay", "-1"), "at least 0 ms"),
        (("--kill", "harness@1"), "only the planner"),
    ],
)
def test_bad_input_is_one_clear_line(
    tmp_path: Path, flags: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert sim(tmp_path / "out", *flags) == 2
    assert words in capsys.readouterr().err


def test_a_stance_that_is_not_led_is_reported_in_words(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lockstep, "READY_NS", 6 * NS_PER_S)
    far = ("--plant", "feet.offset_right=[0.2,0,0]")
    assert sim(tmp_path, "--duration", "1", *far) == 2
    output = capsys.readouterr().err
    assert "the planner did not lead" in output
    assert "ahead of the left" in output
