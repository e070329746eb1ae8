"""The golden log is read and executed again, on any machine.

A change that is meant to change what the services put out remakes it (see `make_golden`).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.bus import topics
from shared.bus.topics import Topic
from shared.exceptions import RunError
from shared.joints import MODULES
from tests.tools.logs.reexecution.executions import executed
from tests.tools.logs.reexecution.make_golden import TRACED
from tools.logs.run_log import RunLog, read_run, robot_of

GOLDEN = Path(__file__).parent / "golden" / "stand.mcap"
OTHER_MACHINES = 2e-6
"""OpenBLAS chooses its kernels, and so the last bits, by processor; they may round differently."""
TRACE, CYCLE = -2, 3
"""Place of a recorded cycle, after the first snapshot."""


def test_the_golden_log_is_read_message_by_message() -> None:
    log = read_run(GOLDEN)
    assert log.complete
    for module in MODULES:
        assert len(log.messages(topics.JOINT_STATE, module)) > 200
        assert len(log.messages(topics.JOINT_COMMAND, module)) > 200
    assert len(log.messages(topics.PLANNER_STATUS)) > 200
    assert robot_of(log).name == log.robot


@pytest.mark.parametrize("name", TRACED)
def test_joint_services_come_out_equal_on_any_machine(name: str) -> None:
    log = read_run(GOLDEN)
    outcome = executed(log, name)
    assert outcome.ticks >= 200
    assert outcome.comparison.first is None


def test_the_planner_comes_out_equal_but_for_last_bits() -> None:
    log = read_run(GOLDEN)
    outcome = executed(log, "planner", OTHER_MACHINES)
    assert outcome.ticks >= 100
    assert outcome.comparison.first is None


class Changed:
    """A log of which one recorded cycle says something else."""

    def __init__(self, log: RunLog, **fields: Any) -> None:
        self._log, self._fields = log, fields

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        found = list(self._log.messages(topic, module))
        if topic is topics.JOINT_TRACE:
            trace = found[TRACE]
            cycles = list(trace.cycles)
            cycles[CYCLE] = msgspec.structs.replace(cycles[CYCLE], **self._fields)
            found[TRACE] = msgspec.structs.replace(trace, cycles=tuple(cycles))
        return found


def test_one_recorded_bit_or_command_that_differs_is_found() -> None:
    log, name = read_run(GOLDEN), TRACED[0]
    cycle = log.messages(topics.JOINT_TRACE, name)[TRACE].cycles[CYCLE]
    torque = (math.nextafter(cycle.tau[0], math.inf), cycle.tau[1])
    outcome = executed(Changed(log, tau=torque), name)
    assert outcome.comparison.differing == 1
    assert outcome.comparison.first is not None
    assert outcome.comparison.first.ulp == 1
    outcome = executed(Changed(log, drive_command=cycle.drive_command + 1), name)
    assert outcome.comparison.differing == 1
    assert outcome.comparison.first is not None
    assert outcome.comparison.first.field.endswith("drive_command")


def test_a_drive_status_that_there_is_not_is_an_error_in_words() -> None:
    with pytest.raises(RunError, match="drive status 9, but the maximum is 6"):
        executed(Changed(read_run(GOLDEN), status=9), TRACED[0])
