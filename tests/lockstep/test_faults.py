"""A drive's fault in virtual time: every row of the fault table, held to."""

from __future__ import annotations

import numpy as np
import pytest

from shared.bus.messages import Cause, DriveStatus, Mode
from shared.can.cansimple import AxisState
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import FAULT_KINDS, Fault, FaultKind, Kill, Restart
from shared.joints import MODULE_INDEX
from shared.robot.fault_table import DRIVE_FAULTS
from tests.lockstep.runs import Run, run, still

MODULE = "hip_left"
AT = 0.5
FIRST = 2 * MODULE_INDEX[MODULE]
AXES = slice(FIRST, FIRST + 2)


def run_with(
    robot: RobotConfig,
    kind: FaultKind,
    duration: float | None = None,
    *,
    module: str = MODULE,
    run_s: float = 1.0,
    restarted_at: float | None = None,
) -> Run:
    fault = Fault(module=module, kind=kind, at=AT, duration=duration)
    at = restarted_at
    kills = () if at is None else (Kill(service=module, at=at),)
    restarts = () if at is None else (Restart(service=module, at=at + 0.02),)
    return run(robot, still(run_s, fault=(fault,), kill=kills, restart=restarts))


def into_fault(outcome: Run) -> list[tuple[str, int, float]]:
    """Return module, cause and scenario time of every change to FAULT."""
    start_ns = outcome.rows[0].t_ns - round(outcome.rows[0].scenario_s * 1e9)
    return [
        (module, event.cause, (event.t_ns - start_ns) / 1e9)
        for module, event in outcome.lockstep.events
        if event.mode_after == Mode.FAULT
    ]


def modes_of(outcome: Run) -> list[Mode]:
    return [controller.failsafe.mode for controller in outcome.lockstep.controllers]


def test_every_kind_of_fault_has_a_row() -> None:
    assert set(DRIVE_FAULTS) == set(FAULT_KINDS)


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_faulted_module_goes_to_fault_for_the_cause_in_its_row_and_the_other_five_hold(
    robot: RobotConfig, kind: FaultKind
) -> None:
    outcome = run_with(robot, kind)
    ((module, cause, at),) = into_fault(outcome)
    silent = DRIVE_FAULTS[kind].cause is Cause.DRIVE_LOST
    assert module == MODULE
    assert cause == DRIVE_FAULTS[kind].cause
    assert AT <= at <= AT + (0.11 if silent else 0.005)
    assert modes_of(outcome).count(Mode.HOLD) == 5


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_both_axes_of_a_module_are_limp_or_neither_is_by_its_row(
    robot: RobotConfig, kind: FaultKind
) -> None:
    bank = run_with(robot, kind).lockstep.bank
    armed = [state == AxisState.CLOSED_LOOP_CONTROL for state in bank.state]
    assert armed[AXES] == [not DRIVE_FAULTS[kind].limp] * 2
    others = np.delete(np.arange(12), [FIRST, FIRST + 1])
    assert all(armed[axis] for axis in others)


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_fault_that_is_over_is_not_left_without_a_request(
    robot: RobotConfig, kind: FaultKind
) -> None:
    lasts = None if FAULT_KINDS[kind].duration is None else 0.2
    outcome = run_with(robot, kind, lasts, run_s=4.0)
    modes = modes_of(outcome)
    assert modes[MODULE_INDEX[MODULE]] is Mode.FAULT
    assert modes.count(Mode.HOLD) == 5
    assert outcome.stood  # on one hip


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_restart_arms_again_unless_the_zero_is_lost(robot: RobotConfig, kind: FaultKind) -> None:
    lasts = None if FAULT_KINDS[kind].duration is None else 0.2
    outcome = run_with(robot, kind, lasts, run_s=5.5, restarted_at=3.0)
    controller = outcome.lockstep.controllers[MODULE_INDEX[MODULE]]
    if DRIVE_FAULTS[kind].zero_lost:
        assert controller.failsafe.mode is Mode.DISARMED
        assert controller.samples.status is DriveStatus.UNZEROED
        assert not outcome.lockstep.bank.torque[AXES].any()
    else:
        assert modes_of(outcome) == [Mode.TRACK] * 6
    assert outcome.stood


def test_what_a_lost_encoder_reports_is_never_taken_for_the_joint(robot: RobotConfig) -> None:
    outcome = run_with(robot, "encoder", module="knee_left", run_s=AT + 0.02)
    lockstep = outcome.lockstep
    theta = lockstep.controllers[MODULE_INDEX["knee_left"]].samples.q[1]
    stand = run(robot, still(AT)).lockstep.controllers[MODULE_INDEX["knee_left"]].samples.q[1]
    assert theta == pytest.approx(stand, abs=0.02)
    steps = [
        max(abs(b - a) for a, b in zip(event.tau_before, event.tau_after, strict=True))
        for module, event in lockstep.events
        if module != "knee_left" and event.mode_after == Mode.HOLD
    ]
    assert max(steps, default=0.0) < 3.0, "1.5 N m measured: what 50 ms of a limp knee add up to"


def test_a_cable_out_for_less_than_it_takes_to_be_lost_changes_nothing(robot: RobotConfig) -> None:
    outcome = run_with(robot, "link_lost", duration=0.04)
    assert into_fault(outcome) == []
    assert outcome.stood


def test_a_drive_with_its_own_loop_holds_while_its_cable_is_out_and_after(
    robot: RobotConfig,
) -> None:
    assert robot.joint_service.loop == "onboard"
    outcome = run_with(robot, "link_lost", 0.5, module="knee_right", run_s=3.0)
    assert outcome.stood
    assert set(outcome.lockstep.bank.state) == {AxisState.CLOSED_LOOP_CONTROL}
    assert outcome.lockstep.controllers[1].failsafe.mode is Mode.FAULT


def test_a_run_with_a_fault_is_bit_identical(robot: RobotConfig) -> None:
    first, second = (run_with(robot, "brown_out") for _ in range(2))
    assert first.rows == second.rows
