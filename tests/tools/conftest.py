"""Recorded runs, for all tests that read one; and a robot that is not emulated."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from shared.config.robot_config import RobotConfig
from shared.config.sections import CanConfig
from tests.tools.judge.reports import runs
from tests.tools.judge.reports.runs import Made
from tests.tools.once import once
from tools import cli
from tools.judge.reports.page import render
from tools.logs.run_log import RunLog, read_run


@pytest.fixture(scope="session")
def real(robot: RobotConfig) -> RobotConfig:
    """Return the shipped robot on real buses."""
    buses = enumerate(robot.can)
    can = {name: CanConfig(interface="socketcan", channel=f"can{i}") for i, name in buses}
    return msgspec.structs.replace(robot, can=can)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A short squat in virtual time: planner killed and restarted, a push, a lost link."""
    folder = once(tmp_path_factory, "made", runs.make)
    return Made(folder / "run.mcap", (folder / "printed.txt").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def log(made: Made) -> RunLog:
    return read_run(made.path)


@pytest.fixture(scope="session")
def page(log: RunLog) -> str:
    return render(log)


IMPAIRED = (
    "planner->joints delay=25 at=0.4 for=0.6",
    "planner->left delay=40 jitter=5 at=0.7 for=0.6",
    "all partition at=1.5 for=0.4",
)


@pytest.fixture(scope="session")
def impaired(tmp_path_factory: pytest.TempPathFactory) -> RunLog:
    """A run over a network that is impaired twice, one over the other, and then cut."""

    def impair(folder: Path) -> None:
        flags = [word for impairment in IMPAIRED for word in ("--inject", impairment)]
        assert cli.main(["sim", "--out", str(folder), "--duration", "2", *flags]) == 0

    return read_run(once(tmp_path_factory, "impaired", impair) / "run.mcap")
