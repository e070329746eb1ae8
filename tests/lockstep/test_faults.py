"""A drive's fault in virtual time: the module that has it, and the other five."""

from __future__ import annotations

import numpy as np
import pytest

from shared.cansimple import AxisState
from shared.config import RobotConfig
from shared.joints import MODULE_INDEX
from shared.messages import Cause, Mode
from shared.scenario import FAULT_KINDS, Fault
from tests.lockstep.runs import Run, run, still

MODULE = "hip_left"
AT = 0.5


def run_with(robot: RobotConfig, kind: str, duration: float | None = None) -> Run:
    fault = Fault(module=MODULE, kind=kind, at=AT, duration=duration)  # type: ignore[arg-type]
    return run(robot, still(1.0, fault=(fault,)))


def into_fault(outcome: Run) -> list[tuple[str, int, float]]:
    """Return module, cause and scenario time of every change to FAULT."""
    start_ns = outcome.rows[0].t_ns - round(outcome.rows[0].scenario_s * 1e9)
    return [
        (module, event.cause, (event.t_ns - start_ns) / 1e9)
        for module, event in outcome.lockstep.events
        if event.mode_after == Mode.FAULT
    ]


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_faulted_module_goes_to_fault_and_the_other_five_hold(
    robot: RobotConfig, kind: str
) -> None:
    outcome = run_with(robot, kind)
    ((module, cause, at),) = into_fault(outcome)
    silent = kind in ("link_lost", "brown_out")
    assert module == MODULE
    assert cause == (Cause.DRIVE_LOST if silent else Cause.DRIVE_DISARMED)
    assert AT <= at <= AT + (0.11 if silent else 0.005)
    modes = [controller.failsafe.mode for controller in outcome.lockstep.controllers]
    assert modes.count(Mode.HOLD) == 5


@pytest.mark.parametrize("kind", [kind for kind in FAULT_KINDS if not FAULT_KINDS[kind].whole])
def test_the_sibling_of_an_axis_that_disarms_is_idled_by_its_service(
    robot: RobotConfig, kind: str
) -> None:
    bank = run_with(robot, kind).lockstep.bank
    first = 2 * MODULE_INDEX[MODULE]
    assert bank.state[first : first + 2] == [AxisState.IDLE] * 2
    others = np.delete(np.arange(12), [first, first + 1])
    assert {bank.state[axis] for axis in others} == {AxisState.CLOSED_LOOP_CONTROL}


def test_a_cable_out_for_less_than_it_takes_to_be_lost_changes_nothing(robot: RobotConfig) -> None:
    outcome = run_with(robot, "link_lost", duration=0.04)
    assert into_fault(outcome) == []
    assert outcome.stood


def test_a_drive_with_its_own_loop_holds_while_its_cable_is_out_and_after(
    robot: RobotConfig,
) -> None:
    assert robot.joint_service.loop == "onboard"
    fault = Fault(module="knee_right", kind="link_lost", at=AT, duration=0.5)
    outcome = run(robot, still(3.0, fault=(fault,)))
    assert outcome.stood
    assert set(outcome.lockstep.bank.state) == {AxisState.CLOSED_LOOP_CONTROL}
    assert outcome.lockstep.controllers[1].failsafe.mode is Mode.FAULT


def test_a_run_with_a_fault_is_bit_identical(robot: RobotConfig) -> None:
    first, second = (run_with(robot, "brown_out") for _ in range(2))
    assert first.rows == second.rows
