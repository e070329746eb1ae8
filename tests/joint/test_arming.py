"""When a module arms its drive, what it says if it does not, and what it knows after a freeze."""

from __future__ import annotations

from itertools import pairwise

import msgspec
import pytest

from services.joint.drive_manager import (
    ARM_EVERY_NS,
    ARM_TRIES,
    GAP_NS,
    ArmingInhibit,
    DriveCommand,
    DriveManager,
)
from services.joint.drive_setpoint import INPUT_TORQUE_SHARE
from services.joint.drivers.base import DriveStatus
from services.joint.neighbours import NeighbourView
from services.joint.rearm_guard import LastState
from services.joint.sinking import DOUBT_NS
from shared.bus.messages import Mode
from shared.clock import NS_PER_S
from shared.config.robot_config import RobotConfig
from tests.joint.test_drive_manager import MOVED, Bench
from tests.joint.test_rearm_guard import CARRIED, Successor


def test_a_drive_that_never_arms_is_asked_so_often_and_reported_once(robot: RobotConfig) -> None:
    bench, told = Bench(robot, "onboard"), []
    for _ in range((ARM_TRIES + 4) * ARM_EVERY_NS // bench.cycle_ns):
        step = bench.cycle()
        bench.status = DriveStatus.IDLE  # it does not do it
        assert step.torque == (0.0, 0.0)
        if step.command is DriveCommand.ARM or step.inhibit is not ArmingInhibit.NONE:
            told.append((bench.now_ns, step.command, step.inhibit))
    assert [row[1:] for row in told] == [
        *[(DriveCommand.ARM, ArmingInhibit.NONE)] * ARM_TRIES,
        (DriveCommand.NOTHING, ArmingInhibit.REFUSED),
    ]
    times = [row[0] for row in told]
    assert {later - sooner for sooner, later in pairwise(times)} == {ARM_EVERY_NS}


def test_after_a_freeze_the_change_of_mode_is_published_with_the_torques_that_were_carried(
    robot: RobotConfig,
) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.TRACK)
    bench.freeze(2 * NS_PER_S, MOVED)
    carried = bench.carried()
    step = bench.cycle()
    assert step.command is DriveCommand.NOTHING, "it listens first"
    assert (step.torque, step.target, step.inhibit) == ((0.0, 0.0), None, ArmingInhibit.NONE)
    event = step.event
    assert event is not None
    assert (event.mode_before, event.mode_after) == (Mode.TRACK, Mode.HOLD)
    assert event.tau_before == pytest.approx(carried)
    assert event.tau_after == pytest.approx(bench.module.controller.tau)
    assert event.tau_after == pytest.approx(carried, abs=1.0)


@pytest.mark.parametrize("status", [DriveStatus.IDLE, DriveStatus.ERROR])
def test_a_module_that_controls_nothing_listens_to_nothing(
    robot: RobotConfig, status: DriveStatus
) -> None:
    bench = Bench(robot, "onboard")
    if status is DriveStatus.ERROR:
        bench.to(Mode.HOLD)
    else:
        bench.cycle(silent=True)
    bench.status = status
    bench.freeze(2 * GAP_NS, MOVED)
    for _ in range(3):
        bench.cycle(silent=status is DriveStatus.IDLE)
        assert bench.module.snapshot().listen_until_ns == 0
    assert bench.mode in (Mode.FAULT, Mode.DISARMED)


def test_what_the_neighbours_do_comes_through(robot: RobotConfig) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.DAMP)
    assert bench.module.needs_neighbours
    for _ in range(2 * DOUBT_NS // bench.cycle_ns):
        bench.now_ns += bench.cycle_ns
        bench.module.step(bench.now_ns, None, None, True, NeighbourView(sinks=False))
    assert bench.module.controller.caught


def test_a_module_that_found_nothing_or_what_let_go_leaves_nothing_holding(
    robot: RobotConfig,
) -> None:
    assert not DriveManager(robot, "knee_left").leaves_holding
    service = Successor(robot, LastState.HELD, DriveStatus.ARMED)
    service.carries = CARRIED
    service.run(ARM_EVERY_NS)
    assert service.module.leaves_holding
    service.status = DriveStatus.IDLE
    service.run(2 * ARM_EVERY_NS)
    assert service.mode is Mode.DISARMED
    assert not service.module.leaves_holding


def test_a_drive_of_unknown_torques_is_no_reason_to_wait_for_a_planner(robot: RobotConfig) -> None:
    service = Successor(robot, LastState.NOTHING, DriveStatus.ARMED)
    assert {step.inhibit for step in service.run(3 * ARM_EVERY_NS)} == {ArmingInhibit.NONE}


@pytest.mark.parametrize(("mark_turns", "forgets"), [(0.0, False), (0.5, True), (40.0, True)])
def test_only_a_drive_with_a_mark_for_no_zero_is_made_to_forget_its_zero(
    robot: RobotConfig, mark_turns: float, forgets: bool
) -> None:
    drive = msgspec.structs.replace(robot.drive, zero_mark_turns=mark_turns)
    bench = Bench(msgspec.structs.replace(robot, drive=drive), "onboard")
    bench.to(Mode.HOLD)
    bench.status = DriveStatus.UNZEROED
    orders = [bench.cycle().command for _ in range(1000)]
    assert bench.mode is Mode.FAULT
    assert orders.count(DriveCommand.CLEAR_ZERO) == int(forgets)


def test_a_module_goes_on_from_all_that_it_remembers(robot: RobotConfig) -> None:
    bench = Bench(robot, "onboard")
    bench.to(Mode.TRACK)
    memory = bench.module.snapshot()
    assert memory.gains_changed_ns > 0
    other = DriveManager(bench.robot, "knee_right")
    other.restore(memory)
    assert other.snapshot() == memory


def test_a_motors_torque_is_within_what_its_current_gives(robot: RobotConfig) -> None:
    """N m of the motor: current limit times torque constant, not over it."""
    drive = robot.drive
    most = drive.current_lim * drive.torque_constant
    bench = Bench(robot, "onboard")
    bench.to(Mode.HOLD)
    assert bench.module._law._input_max == pytest.approx(INPUT_TORQUE_SHARE * most)


def test_a_drive_that_was_taken_over_counts_as_asked_once(robot: RobotConfig) -> None:
    service = Successor(robot, LastState.HELD, DriveStatus.ARMED)
    service.carries = CARRIED
    for _ in range(3):
        service.lead(hold=True)
    assert service.mode is Mode.HOLD
    assert service.module.snapshot().tries == 1
