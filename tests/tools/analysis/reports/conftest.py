from __future__ import annotations

import pytest

from tests.tools.analysis.reports import runs
from tests.tools.analysis.reports.runs import Made
from tools.analysis.reports.page import render
from tools.runs.run_log import RunLog, read_run


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
