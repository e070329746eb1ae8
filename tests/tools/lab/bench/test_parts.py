"""Every part of the bench runs on what a short squat gave it."""

from __future__ import annotations

import time
from contextlib import ExitStack

import pytest

from shared.config import scenarios
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES
from tools.lab.bench import parts
from tools.lab.bench.parts import FIGURES, PARTS, Bench, Part, Recorded, Repeated, measure
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
