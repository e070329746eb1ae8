"""`xrl bench`: figures from records, medians of turns, another tree; transports; parts."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from shared.bus import codec, topics
from shared.bus.messages import JointCommand, PlannerStatus
from shared.bus.traces import CycleTrace, JointTrace
from shared.clock import NS_PER_MS
from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import MODULES
from shared.places import CHECKOUT
from tests.messages import sample
from tests.shared.mcap_log.runs import ROBOT, write
from tests.tools.exit_codes import exit_code
from tools.lab.bench import bus, fleet, parts, table
from tools.lab.bench.bus import Seen, over_datagrams
from tools.lab.bench.parts import FIGURES, PARTS, Bench, Part, Recorded, Repeated, measure
from tools.lab.bench.table import Figure, Row, Turn, row_of, run_tree
from tools.live.experiment import scenario_file
from tools.logs.run_log import read_run

SUMMARY = {"planner_tick_us": {"median": 200.0, "p99": 400.0}, "fleet_cpu_pct": 90.0}


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
    cycles = [
        cycle(now_ms, seq)
        for now_ms, seq in ((102.0, 1), (104.0, -1), (203.0, 2), (305.5, 3), (405.0, 4))
    ]
    sent = topics.PLANNER_STATUS.key(ROBOT)
    traced = topics.JOINT_TRACE.key(ROBOT, "knee_left")
    statuses = [sample(PlannerStatus, commands=(command,) * 6) for command in commands]
    items = [(sent, codec.encode(one), number) for number, one in enumerate(statuses)]
    trace = JointTrace.of(cycles, seq=1, snapshot="")
    write(tmp_path, [*items, (traced, codec.encode(trace), len(items))])
    assert fleet.first_use_ms(read_run(tmp_path)).tolist() == [2.0, 5.5]


def test_a_record_without_commands_and_an_older_summary_leave_figures_out() -> None:
    found = fleet.figures(SUMMARY, np.zeros(0))
    known = {name: value for name, value in found.items() if value is not None}
    assert known == {"tick, median": 200.0, "tick, p99": 400.0, "CPU, all processes": 90.0}
    aged = fleet.figures({}, np.array([1.0, 2.0, 3.0]))
    assert aged["age at first use, median"] == 2.0


def test_turns_are_compared_one_by_one() -> None:
    """The machine was half as fast in the second turn: the ratio does not see it."""
    here: list[Turn] = [{"tick": us} for us in (200.0, 400.0, 210.0)]
    there: list[Turn] = [{"tick": us} for us in (250.0, 500.0, 300.0)]
    row = row_of(Figure("tick", "us", 205.0), here, there)
    assert (row.value, row.spread, row.other) == (210.0, (200.0, 400.0), 300.0)
    assert row.ratio == pytest.approx(0.8)
    assert not row.ok
    assert row_of(Figure("tick", "us"), [{"tick": None}], []) == Row("tick", "us", None, None)


def test_a_faster_lockstep_has_a_ratio_below_one_and_meets_a_target_from_above() -> None:
    row = row_of(Figure("lockstep", "x", 4.0), [{"lockstep": 4.0}], [{"lockstep": 2.0}])
    assert row == Row("lockstep", "x", 4.0, (4.0, 4.0), other=2.0, ratio=0.5, target=4.0)
    assert row.ok
    assert not row._replace(target=4.1).ok


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a source tree whose `xrl` is what a test writes into `tools/cli.py`."""
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools/__init__.py").touch()
    return tmp_path


def test_a_run_that_fell_is_an_error_with_its_last_lines(tree: Path) -> None:
    program = "print('Verdict'); print('one'); print('FELL at 3.1 s'); print('files'); exit(1)"
    (tree / "tools/cli.py").write_text(program)
    with pytest.raises(RunError, match=r"ended with exit code 1: one / FELL at 3\.1 s / files"):
        run_tree(tree, ["demo"])


def test_a_run_that_does_not_end_is_interrupted_and_may_clear_up(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table, "PATIENCE_S", 5.0)
    (tree / "tools/cli.py").write_text("""
import pathlib, time
try:
    while True:
        time.sleep(0.05)
except KeyboardInterrupt:
    pathlib.Path("cleared").touch()
""")
    with pytest.raises(RunError, match="has not ended after 5 s"):
        run_tree(tree, [])
    assert (tree / "cleared").exists()


def test_an_unknown_revision_is_refused_by_name_before_a_fleet_starts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(table, "run_tree", lambda *_: pytest.fail("a fleet was started"))
    assert exit_code(["bench", "fleet", "--against", "no-such"]) == 2
    assert "no-such: no such git revision" in capsys.readouterr().err


def test_two_trees_take_turns_and_a_missed_target_is_told_by_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    (tmp_path / "law.py").write_text("old")
    identity = ["-c", "user.name=x", "-c", "user.email=x@example.invalid"]
    for words in (["add", "law.py"], ["commit", "-qm", "one"]):
        subprocess.run(["git", *identity, *words], cwd=tmp_path, check=True)
    trees: list[Path] = []

    def run(tree: Path, words: Sequence[str], module: str = "tools.cli") -> str:
        if module == "tools.graph_libraries":
            return ""
        trees.append(tree)
        assert words[:2] == ["bench", "fleet"]
        mine = 350.0 if tree == tmp_path else 700.0
        row = {"what": "tick, median", "value": mine}
        Path(words[-1]).write_text(json.dumps([row]))
        return ""

    monkeypatch.setattr(table, "CHECKOUT", tmp_path)
    monkeypatch.setattr(table, "run_tree", run)
    monkeypatch.setattr(table, "need_checkout", lambda _word: None)
    file = tmp_path / "fleet.json"
    words = ["bench", "fleet", "--against", "HEAD", "--rounds", "2", "--strict", "--json"]
    assert exit_code([*words, file]) == 3
    assert len(trees) == 4
    assert trees[0] == trees[2] == tmp_path
    assert not trees[1].exists(), "the other tree goes afterwards"
    assert "missed" in capsys.readouterr().out
    row = json.loads(file.read_text())[0]
    assert (row["value"], row["other"], row["ratio"]) == (350.0, 700.0, 0.5)
    assert tmp_path != CHECKOUT


def test_figures_are_over_the_commands_of_all_modules() -> None:
    seen: list[Seen] = [([1000.0] * 99, 9, 0.05), ([3000.0], 1, 0.05), ([], 0, 0.05)]
    found = bus.figures("zmq", seen)
    assert found["p50 ms"] == 1.0
    assert found["p99.9 ms"] > 2.5
    assert found["missed %"] == pytest.approx(10.0)
    assert found["CPU %"] == pytest.approx(15.0)
    with pytest.raises(RunError, match="zmq: no command arrived"):
        bus.figures("zmq", [([], 0, 0.0)])


def test_over_datagrams_the_newest_payload_is_taken_once(tmp_path: Path) -> None:
    (_, latest), (publisher, _) = (over_datagrams(name, tmp_path) for name in ("a", "b"))
    put = publisher("state_a")
    put(b"nobody is there yet")
    take = latest("state_a")
    assert take() is None
    for number in range(3):
        put(b"%d" % number)
    assert take() == b"2"
    assert take() is None


@pytest.mark.system
@pytest.mark.parametrize("transport", ["zenoh", "datagrams"])
def test_six_modules_and_a_planner_exchange_states_and_commands(transport: str) -> None:
    found = bus.measure(transport, 2.0)
    assert found["p50 ms"] > 0.0
    assert found["CPU %"] > 0.0


@pytest.mark.system
def test_a_process_that_fails_is_an_error() -> None:
    with pytest.raises(KeyError):
        bus.measure("no-such", 0.1)


@pytest.fixture(scope="module")
def recorded(robot: RobotConfig) -> Recorded:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parts, "SECONDS", 0.2)
        return parts.record(robot, scenarios.load(scenario_file("squat")))


def test_a_recording_holds_what_the_planner_and_a_joint_service_were_given(
    recorded: Recorded,
) -> None:
    assert len(recorded.ticks) == pytest.approx(50, abs=3)
    assert all(len(states) == len(MODULES) for _, states in recorded.ticks)
    assert len(recorded.cycles) == pytest.approx(100, abs=4)
    assert all(one.action.target is not None for one in recorded.cycles)
    assert any(one.arguments[2] is not None for one in recorded.cycles), "commands came"


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_a_part_runs_longer_than_its_recording(recorded: Recorded, part: Part) -> None:
    with ExitStack() as stack:
        assert measure(part.prepare(recorded, stack), 120) > 0.0


def test_each_cold_call_is_prepared_then_follows_a_sweep_and_a_sleep(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(time, "sleep", lambda _s: calls.append("sleep"))
    measure(Repeated(lambda: calls.append("once"), lambda: calls.append("before")), 2, cold=True)
    assert calls == ["before", "sleep", "once"] * 2


def test_a_turn_has_every_figure(robot: RobotConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "SECONDS", 0.15)
    monkeypatch.setattr(parts, "PIECE_S", 0.05)
    monkeypatch.setattr(parts, "PARTS", PARTS[2:3])
    monkeypatch.setattr(parts, "CALLS", {"warm": 2, "cold": 2})
    squat = scenarios.load(scenario_file("squat"))
    with ExitStack() as stack:
        turn = Bench(robot, squat, stack).turn()
    assert set(turn) < {figure.what for figure in FIGURES}
    assert len(turn) == 4
    assert all(value is not None and value > 0.0 for value in turn.values())
