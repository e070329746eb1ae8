"""Logs of earlier versions stay readable; the newest is executed again.

A change that is meant to change what the services put out makes a new golden log (see
`make_golden`): the old one stays, and is read.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from shared.bus import topics
from shared.robot.joints import MODULES
from tests.tools.analysis.reexecution.executions import executed
from tests.tools.analysis.reexecution.make_golden import TRACED
from tools.runs.recorded_robot import robot_of
from tools.runs.run_log import read_run

GOLDEN = sorted((Path(__file__).parent / "golden").glob("*.mcap"))
NEWEST = GOLDEN[-1]
OTHER_MACHINES = 1e-6
"""OpenBLAS picks its kernels by processor, and with them the last bits."""


def test_there_is_a_golden_log() -> None:
    assert GOLDEN


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_a_golden_log_is_read_message_by_message(path: Path) -> None:
    log = read_run(path)
    assert log.complete
    for module in MODULES:
        assert len(log.messages(topics.JOINT_STATE, module)) > 200
        assert len(log.messages(topics.JOINT_COMMAND, module)) > 200
    assert len(log.messages(topics.PLANNER_STATUS)) > 200
    assert robot_of(log).name == log.robot


@pytest.mark.parametrize("name", TRACED)
def test_joint_services_of_the_newest_come_out_equal_on_any_machine(name: str) -> None:
    log = read_run(NEWEST)
    outcome = executed(log, name)
    assert outcome.ticks >= 200
    assert outcome.comparison.first is None


def test_the_planner_of_the_newest_comes_out_equal_but_for_last_bits() -> None:
    log = read_run(NEWEST)
    outcome = executed(log, "planner", OTHER_MACHINES)
    assert outcome.ticks >= 100
    assert outcome.comparison.first is None
