"""The golden log is read and executed again, on any machine.

A change that is meant to change what the services put out remakes it (see `make_golden`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shared.bus import topics
from shared.bus.messages import JointState
from shared.bus.topics import Topic
from shared.bus.traces import JointTrace
from shared.exceptions import RunError
from shared.joints import MODULES
from tests.tools.logs.reexecution.executions import executed
from tests.tools.logs.reexecution.make_golden import TRACED
from tools.logs.run_log import RunLog, read_run, robot_of

GOLDEN = Path(__file__).parent / "golden" / "stand.mcap"
OTHER_MACHINES = 1e-9
"""OpenBLAS chooses its kernels, and so the last bits, by processor; they may round differently."""
PLACE, CYCLE = -9, 3
"""Places of a message, after the first snapshot, and of a cycle in a trace."""


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
    """A log of which one message says something else."""

    def __init__(self, log: RunLog, topic: Topic, change: Callable[[Any], Any]) -> None:
        self._log, self._topic, self._change = log, topic, change

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def messages(self, topic: Topic, module: str = "") -> list[Any]:
        found = list(self._log.messages(topic, module))
        if topic is self._topic:
            found[PLACE] = self._change(found[PLACE])
        return found


def with_cycle(**fields: Any) -> Callable[[JointTrace], JointTrace]:
    """Return a function that changes fields of one cycle of a trace."""

    def changed(trace: JointTrace) -> JointTrace:
        cycles = trace.cycles
        cycles[CYCLE] = msgspec.structs.replace(cycles[CYCLE], **fields)
        return JointTrace.of(cycles, trace.seq, trace.snapshot)

    return changed


def with_torque_one_bit_higher(state: JointState) -> JointState:
    a, b = state.tau
    return msgspec.structs.replace(state, tau=(math.nextafter(a, math.inf), b))


def test_one_recorded_bit_or_command_that_differs_is_found() -> None:
    log, name = read_run(GOLDEN), TRACED[0]
    outcome = executed(Changed(log, topics.JOINT_STATE, with_torque_one_bit_higher), name)
    assert outcome.comparison.differing == 1
    assert outcome.comparison.first is not None
    assert outcome.comparison.first.ulp == 1
    command = log.messages(topics.JOINT_TRACE, name)[PLACE].cycles[CYCLE].drive_command
    other = with_cycle(drive_command=command + 1)
    outcome = executed(Changed(log, topics.JOINT_TRACE, other), name)
    assert outcome.comparison.differing == 1
    assert outcome.comparison.first is not None
    assert outcome.comparison.first.field == "columns.drive_command[0]"


def test_a_drive_status_that_there_is_not_is_an_error_in_words() -> None:
    with pytest.raises(RunError, match="drive status 9, but the maximum is 6"):
        executed(Changed(read_run(GOLDEN), topics.JOINT_TRACE, with_cycle(status=9)), TRACED[0])
