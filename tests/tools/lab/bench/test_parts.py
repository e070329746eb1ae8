"""Every part of the bench runs on what a short squat gave it."""

from __future__ import annotations

import subprocess
from contextlib import ExitStack
from pathlib import Path

import pytest

from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.exceptions import RunError
from shared.joints import MODULES
from shared.places import CHECKOUT, DEFAULT_CONFIG
from tools.lab.bench import parts, revisions, timing
from tools.lab.bench.parts import PARTS, Part, Recorded
from tools.lab.bench.revisions import worker
from tools.lab.bench.timing import Repeated, measure
from tools.lab.bench.worker import Bench, Request
from tools.live.experiment import scenario_file


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
        cost = measure(part.prepare(recorded, stack), 120, cold=False)
    assert 0.0 < cost.cpu.p10 <= cost.cpu.p50 <= cost.cpu.p90
    assert cost.wall.p50 > 0.0


def test_each_cold_call_is_prepared_then_follows_a_sweep_and_a_sleep(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(timing.time, "sleep", lambda _s: calls.append("sleep"))
    measure(Repeated(lambda: calls.append("once"), lambda: calls.append("before")), 2, cold=True)
    assert calls == ["before", "sleep", "once"] * 2


@pytest.mark.parametrize("kept", [False, True])
def test_lockstep_has_a_speed_with_and_without_a_record_beyond_a_run_too(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch, kept: bool
) -> None:
    monkeypatch.setattr(parts, "SECONDS", 0.15)
    monkeypatch.setattr(parts, "PIECE_S", 0.1)
    squat = scenarios.load(scenario_file("squat"))
    with ExitStack() as stack:
        run = parts.LockstepRun(robot, squat, stack, recorded=kept)
        assert all(run.speed() > 0.05 for _ in range(3))


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a repository with one commit, and a bench that is newer than it."""
    (tmp_path / "law.py").write_text("old")
    for command in (["init", "-q"], ["add", "law.py"], ["commit", "-qm", "one"]):
        identity = ["-c", "user.name=x", "-c", "user.email=x@example.invalid"]
        subprocess.run(["git", *identity, *command], cwd=tmp_path, check=True)
    (tmp_path / "law.py").write_text("new")
    (tmp_path / "tools/lab/bench").mkdir(parents=True)
    (tmp_path / "tools/lab/bench/worker.py").write_text("new")
    monkeypatch.setattr(revisions, "CHECKOUT", tmp_path)
    return tmp_path


@pytest.mark.usefixtures("checkout")
def test_another_revision_is_measured_by_this_trees_bench_and_goes_afterwards() -> None:
    with revisions.unpacked("HEAD") as tree:
        assert (tree / "law.py").read_text() == "old"
        assert (tree / "tools/lab/bench/worker.py").read_text() == "new"
    assert not tree.exists()


def test_a_bench_that_cannot_start_is_an_error_with_its_last_line(tmp_path: Path) -> None:
    with (
        worker(CHECKOUT, tmp_path / "no.toml") as ask,
        pytest.raises(RunError, match=r"the bench ended with 1: .*no\.toml"),
    ):
        ask(Request("planner tick", calls=1))


def test_a_bench_answers_for_each_part_and_names_one_it_cannot_run(
    robot: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_recorded: Recorded, _stack: ExitStack) -> Repeated:
        raise AttributeError("no such thing in this tree")

    monkeypatch.setattr(parts, "SECONDS", 0.1)
    monkeypatch.setattr(parts, "PARTS", (PARTS[2], Part("gone", broken)))
    with ExitStack() as stack:
        bench = Bench(DEFAULT_CONFIG, stack)
        cost = bench.answer(Request(PARTS[2].name, calls=3)).cost
        assert cost is not None
        assert cost.cpu.p50 > 0.0
        gone = bench.answer(Request("gone", calls=3))
        assert gone.missing == "AttributeError: no such thing in this tree"
        assert bench.answer(Request(parts.LOCKSTEP)).speed is not None
