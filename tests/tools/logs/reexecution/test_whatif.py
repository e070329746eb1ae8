"""A recorded run gone on with in another way, from a moment in the middle of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.simulator.physics.plant import PlantConfig
from shared.bus import topics
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Fault, Scenario
from shared.exceptions import RunError
from tests.lockstep.runs import kill, push, run, still
from tests.tools.judge.reports.runs import Made
from tools import cli
from tools.lab.studies.counterfactual import (
    Moment,
    Task,
    counterfactual_of,
    moments_of,
    scenario_from,
)
from tools.logs.run_log import RunLog, read_run, robot_of
from tools.sim.network import BASE
from tools.sim.recorded_lockstep import simulate

HARD = push(1.6, 150.0, 0.0, 0.0)
"""That the robot falls over by."""


def record(robot: RobotConfig, scenario: Scenario, folder: Path) -> RunLog:
    simulate(robot, scenario, BASE, 0, folder)
    return read_run(folder / "run.mcap")


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return still(2.0, height=1.1, push=(push(1.2, 30.0, 0.0, 0.0),))


@pytest.fixture(scope="module")
def log(robot: RobotConfig, scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> RunLog:
    return record(robot, scenario, tmp_path_factory.mktemp("whatif"))


@pytest.fixture(scope="module")
def moments(log: RunLog) -> list[Moment]:
    return moments_of(log, robot_of(log), 0.5)


def test_a_lasting_fault_that_began_before_the_moment_goes_on_for_the_rest_of_its_time() -> None:
    faults = (
        Fault(module="knee_left", kind="link_lost", at=1.0, duration=3.0),
        Fault(module="hip_left", kind="link_lost", at=0.5, duration=1.0),
        Fault(module="hip_right", kind="over_voltage", at=1.5),
        Fault(module="ankle_left", kind="over_voltage", at=2.5),
    )
    rest = scenario_from(still(5.0, fault=faults), 2.0, (), 2.0)
    assert rest.fault == (
        Fault(module="knee_left", kind="link_lost", at=2.0, duration=2.0),
        faults[3],
    )


def test_moments_are_as_far_apart_as_asked_and_have_everybody_in_them(
    moments: list[Moment],
) -> None:
    assert [round(moment.at_s, 1) for moment in moments] == [0.2, 0.6, 1.0, 1.6, 2.0]
    assert all(len(moment.modules) == 6 for moment in moments)
    assert all(moment.planner is not None for moment in moments)
    assert all(moment.margin is not None and moment.margin > 0.5 for moment in moments)


def test_gone_on_with_unchanged_it_comes_out_as_it_was(
    robot: RobotConfig, log: RunLog, moments: list[Moment], scenario: Scenario
) -> None:
    fate = counterfactual_of(Task(robot_of(log), scenario, PlantConfig(), moments[2], (), 1.0))
    truth: list[SimTruth] = log.messages(topics.SIM_TRUTH)
    late = [row for row in truth if moments[2].at_s <= row.scenario_s < moments[2].at_s + 1.0]
    assert fate.stood
    assert fate.com_x_max_mm == pytest.approx(1e3 * max(abs(row.com[0]) for row in late), abs=0.3)


def test_a_kill_in_a_counterfactual_is_the_kill_in_a_run(
    robot: RobotConfig, log: RunLog, moments: list[Moment], scenario: Scenario
) -> None:
    fate = counterfactual_of(
        Task(robot_of(log), scenario, PlantConfig(), moments[2], ("planner",), 1.0)
    )
    killed = run(
        robot, still(2.0, height=1.1, push=scenario.push, kill=kill(moments[2].at_s + 1e-3))
    )
    after = killed.com_mm[killed.t >= moments[2].at_s]
    assert fate.stood
    assert killed.stood
    assert fate.com_x_max_mm == pytest.approx(abs(after[:, 0]).max(), abs=0.5)


def test_a_joint_service_can_die_in_it_too(
    log: RunLog, moments: list[Moment], scenario: Scenario
) -> None:
    assert counterfactual_of(
        Task(robot_of(log), scenario, PlantConfig(), moments[1], ("planner", "knee_left"), 1.5)
    ).stood


def test_a_fall_is_a_fall_there_as_well(
    robot: RobotConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = still(1.8, push=(HARD,))
    record(robot, scenario, tmp_path)
    arguments = ["--kill", "planner", "--every", "1.4", "--for", "1.55", "--workers", "1"]
    assert _main([str(tmp_path / "run.mcap"), *arguments]) == 1
    text = capsys.readouterr().out
    assert "1 fell" in text
    assert "fell when killed at 1.4 s" in text
    assert (tmp_path / "whatif.png").stat().st_size > 10_000
    assert '"stood": false' in (tmp_path / "whatif.json").read_text(encoding="utf-8")


def test_no_moment_counts_at_which_the_service_was_dead_already(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is dead from 1 to 1.8 s."""
    words = [str(made.path), "--kill", "planner", "--for", "0.3", "--workers", "1"]
    words += ["--every", "0.5", "--out", str(tmp_path)]
    assert _main([*words, "--to", "1.7"]) == 0
    assert "planner killed at 3 moments at which it ran" in capsys.readouterr().out
    assert _main([*words, "--from", "1.2", "--to", "1.7"]) == 2
    assert "planner: did not run" in capsys.readouterr().err


def test_a_run_without_a_simulated_world_is_refused(log: RunLog) -> None:
    key = topics.SIM_STATE.key(log.robot)
    kept = log._series.pop(key)
    try:
        with pytest.raises(RunError, match="sim/state"):
            moments_of(log, robot_of(log), 0.5)
    finally:
        log._series[key] = kept


def _main(arguments: list[str]) -> int:
    return cli.main(["log", "whatif", *arguments])
