"""A run that was split while it was recorded: read, executed again and reported as one."""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Kill, Restart
from shared.exceptions import RunError
from shared.joints import MODULES
from tests.lockstep.runs import still
from tests.tools.logs.reexecution.executions import executed
from tests.tools.logs.split_runs import recorded_in_parts
from tools import cli
from tools.logs.run_log import RunLog, read_run
from tools.sim.network import BASE
from tools.sim.recorded_lockstep import simulate


@pytest.fixture(scope="module")
def whole(robot: RobotConfig, tmp_path_factory: pytest.TempPathFactory) -> RunLog:
    scenario = still(
        2.5,
        height=1.1,
        kill=(Kill(service="planner", at=0.5),),
        restart=(Restart(service="planner", at=0.8),),
    )
    folder = tmp_path_factory.mktemp("whole")
    simulate(robot, scenario, BASE, 3, folder)
    return read_run(folder / "run.mcap")


@pytest.fixture(scope="module")
def directory(whole: RunLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded_in_parts(whole, tmp_path_factory.mktemp("split"))


def test_the_directory_of_a_split_run_is_the_run(whole: RunLog, directory: Path) -> None:
    log = read_run(directory)
    assert [path.name for path in log.files] == ["run.mcap", "run_1.mcap", "run_2.mcap"]
    assert (log.complete, log.damage, log.attachments) == (True, [], whole.attachments)
    assert {key: log.raw(key) for key in log.keys()} == {  # noqa: SIM118
        key: whole.raw(key)
        for key in whole.keys()  # noqa: SIM118
    }
    assert log.began_ns() == whole.began_ns()


@pytest.mark.parametrize("name", ["planner", MODULES[0]])
def test_a_split_run_is_executed_again_across_its_files(directory: Path, name: str) -> None:
    log = read_run(directory)
    outcome = executed(log, name)
    assert outcome.comparison.first is None
    assert (outcome.lost_inputs, outcome.starts) == (0, 2 if name == "planner" else 1)
    assert outcome.skipped <= 4


def test_one_file_of_a_split_run_stands_for_itself(directory: Path) -> None:
    log = read_run(directory / "run_1.mcap")
    outcome = executed(log, "ankle_left")
    assert outcome.comparison.first is None
    assert outcome.ticks > 0


def test_a_new_file_with_a_parameter_goes_beside_the_first(directory: Path) -> None:
    words = ["log", "resim", str(directory), "--service", "planner", "--param", "gains.k_p_x=2000"]
    assert cli.main(words) == 0
    new = directory / "run.resim.mcap"
    try:
        assert read_run(new).metadata["log", "resim"]["params"] == "gains.k_p_x=2000"
        assert len(read_run(directory).files) == 3, "it is no part of the run"
    finally:
        new.unlink()


def test_a_directory_without_a_run_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"holds no \.mcap file"):
        read_run(tmp_path)
