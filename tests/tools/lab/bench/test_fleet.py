"""`xrl bench fleet`: figures from records, medians of turns, and a run that is ended with us."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from shared.bus import codec, topics
from shared.bus.messages import JointCommand
from shared.bus.traces import CycleTrace, JointTrace
from shared.clock import NS_PER_MS
from shared.exceptions import RunError
from shared.places import CHECKOUT, DEFAULT_CONFIG
from tests.shared.mcap_log.runs import ROBOT, sample, write
from tests.tools.exit_codes import exit_code
from tools.lab.bench import fleet, revisions
from tools.lab.bench.fleet import FIGURES, Turn
from tools.logs.run_log import read_run

SUMMARY = {"planner_tick_us": {"median": 200.0, "p99": 400.0}, "fleet_cpu_pct": 90.0}


def turn(**known: float) -> Turn:
    return {figure.name: known.get(figure.name) for figure in FIGURES}


def cycle(now_ms: float, seq: int) -> CycleTrace:
    """Return a cycle that took a command; -1: none came."""
    taken: CycleTrace = sample(
        CycleTrace, now_ns=int(now_ms * NS_PER_MS), session=7, command_seq=seq
    )
    return taken


def test_an_age_is_that_of_a_leading_command_in_the_cycle_that_took_it(tmp_path: Path) -> None:
    commands = [
        sample(JointCommand, session=7, seq=seq, echo_t_ns=100 * NS_PER_MS * seq, hold=hold)
        for seq, hold in ((1, False), (2, True), (3, False))
    ]
    cycles = tuple(
        cycle(now_ms, seq)
        for now_ms, seq in ((102.0, 1), (104.0, -1), (203.0, 2), (305.5, 3), (405.0, 4))
    )
    sent = topics.JOINT_COMMAND.key(ROBOT, "knee_left")
    traced = topics.JOINT_TRACE.key(ROBOT, "knee_left")
    items = [(sent, codec.encode(one), number) for number, one in enumerate(commands)]
    trace = sample(JointTrace, cycles=cycles, snapshot="")
    write(tmp_path, [*items, (traced, codec.encode(trace), len(items))])
    assert fleet.first_use_ms(read_run(tmp_path)).tolist() == [2.0, 5.5]


def test_a_record_without_commands_and_an_older_summary_leave_figures_out() -> None:
    found = fleet.figures(SUMMARY, np.zeros(0))
    assert found == turn(tick_us=200.0, tick_p99_us=400.0, cpu_pct=90.0)
    assert fleet.figures({}, np.array([1.0, 2.0, 3.0]))["first_use_ms"] == 2.0


def test_each_figure_has_a_row_and_its_target_holds_for_real_time_only() -> None:
    slow = [turn(tick_us=301.0)]
    row, *_, hand, _ = fleet.rows(slow, [turn(hand_n=20.0)], 1.0)
    assert (row.what, row.value, row.target, row.ok) == ("tick, median", 301.0, 300.0, False)
    assert (hand.value, hand.spread, hand.other, hand.ratio) == (None, None, 20.0, None)
    assert hand.ok
    assert fleet.rows(slow, (), 0.5)[0].ok


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a source tree whose `xrl` is what a test writes into `tools/cli.py`."""
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools/__init__.py").touch()
    return tmp_path


def led(tree: Path, program: str) -> Turn:
    (tree / "tools/cli.py").write_text(program)
    return fleet.measure(tree, DEFAULT_CONFIG, "squat", 1.0)


@pytest.mark.system
def test_a_run_that_fell_is_an_error_with_its_last_lines(tree: Path) -> None:
    program = "print('Verdict'); print('one'); print('FELL at 3.1 s'); print('files'); exit(1)"
    with pytest.raises(RunError, match=r"ended with 1: one / FELL at 3\.1 s / files"):
        led(tree, program)


@pytest.mark.system
def test_a_run_that_does_not_end_is_interrupted_and_may_clear_up(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet, "PATIENCE_S", 2.0)
    program = """
import pathlib, time
try:
    while True:
        time.sleep(0.05)
except KeyboardInterrupt:
    pathlib.Path("cleared").touch()
"""
    with pytest.raises(RunError, match="has not ended after 2 s"):
        led(tree, program)
    assert (tree / "cleared").exists()


def test_an_unknown_revision_is_refused_by_name_before_a_fleet_starts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fleet, "measure", lambda *_: pytest.fail("a fleet was started"))
    assert exit_code(["bench", "fleet", "--against", "no-such"]) == 2
    assert "no-such: no git revision here" in capsys.readouterr().err


def test_two_trees_take_turns_and_a_missed_target_is_told_by_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trees: list[Path] = []

    def measure(tree: Path, config: Path, scenario: str, pace: float) -> Turn:
        assert config == tree / DEFAULT_CONFIG.relative_to(CHECKOUT)
        assert (scenario, pace) == ("squat", 1.0)
        trees.append(tree)
        return turn(tick_us=350.0 if tree == CHECKOUT else 700.0, hand_n=20.0)

    @contextmanager
    def unpacked(_revision: str) -> Iterator[Path]:
        yield tmp_path

    monkeypatch.setattr(fleet, "measure", measure)
    monkeypatch.setattr(revisions, "unpacked", unpacked)
    file = tmp_path / "fleet.json"
    words = ["bench", "fleet", "--against", "old", "--rounds", "2", "--strict", "--json", file]
    assert exit_code(words) == 3
    assert trees == [CHECKOUT, tmp_path] * 2
    printed = capsys.readouterr().out
    assert "missed" in printed
    assert "0.50" in printed
    row = json.loads(file.read_text())[0]
    assert (row["figure"], row["value"], row["other"], row["ratio"]) == (
        "tick, median", 350.0, 700.0, 0.5,
    )  # fmt: skip
