from __future__ import annotations

import pytest

from tests.tools.judge.reports import runs
from tests.tools.judge.reports.runs import Made
from tools.judge.reports.page import render
from tools.logs.run_log import RunLog, read_run


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A short squat in virtual time: planner killed and restarted, a push, a lost link."""
    return runs.make(tmp_path_factory.mktemp("report") / "run")


@pytest.fixture(scope="session")
def log(made: Made) -> RunLog:
    return read_run(made.path)


@pytest.fixture(scope="session")
def page(log: RunLog) -> str:
    return render(log)
