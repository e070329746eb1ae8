"""What a joint service leaves to its successor: nothing takes hold again unless it is asked to.

And the stops that reach it without a bus: by shared memory, and by a pendant's silence.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from services.joint.differential import joint_torque, motor_from_joint
from services.joint.drive_manager import ARM_EVERY_NS, ArmingInhibit, DriveCommand, DriveManager
from services.joint.rearm_guard import (
    PENDANT,
    LastState,
    Pendant,
    PendantWatch,
    RearmGuard,
    clear,
    request_stop,
    stop_source,
)
from shared.bus.messages import DriveStatus, Estop, Mode, Pair
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import MODULES
from tests.joint.helpers import ROBOT, ModuleBench
from tests.joint.test_loop import Rig

MODULE = "knee_right"
CARRIED: Pair = (0.3, 1.4)
"""Motor torques that a drive found armed tells, N m."""


def successor(
    last_state: LastState, status: DriveStatus = DriveStatus.ARMED, carries: Pair | None = CARRIED
) -> ModuleBench:
    """Return a service after one that left `last_state`, and the drive that it finds."""
    carries = carries if status is DriveStatus.ARMED else None
    return ModuleBench(ROBOT, last_state=last_state, status=status, carries=carries, obeys=False)


def orders(service: ModuleBench, lasting_ns: int) -> set[DriveCommand]:
    return {step.command for step in service.run(lasting_ns)}


@pytest.mark.parametrize("stopped", [True, False])
def test_a_service_that_faults_leaves_that_it_held_or_was_stopped(stopped: bool) -> None:
    service = successor(LastState.NOTHING, DriveStatus.IDLE)
    assert service.cycle().command is DriveCommand.ARM
    assert service.module.state.last_state is LastState.NOTHING, "it may not come to hold"
    service.status = DriveStatus.ARMED
    service.cycle()
    assert service.module.state.last_state is LastState.HELD
    service.lead(200)
    assert (service.mode, service.module.state.last_state) == (Mode.TRACK, LastState.HELD)
    last = LastState.DAMP if stopped else LastState.HELD
    service.cycle(estop=stopped)
    assert service.module.state.last_state is last
    service.status = DriveStatus.ERROR
    service.cycle()
    assert (service.mode, service.module.state.last_state) == (Mode.FAULT, last)


@pytest.mark.parametrize("status", [DriveStatus.IDLE, DriveStatus.ERROR])
@pytest.mark.parametrize("last_state", [LastState.HELD, LastState.DAMP])
@pytest.mark.parametrize("led", [True, False])
def test_a_drive_that_held_and_has_let_go_is_not_armed_by_a_service_that_was_not_asked_for(
    status: DriveStatus, last_state: LastState, led: bool
) -> None:
    """The supervisor starts what crashes: it armed under load, with a step of 28 N m."""
    service = successor(last_state, status)
    steps = service.lead(2000) if led else service.run(4 * NS_PER_S)
    assert DriveCommand.ARM not in {step.command for step in steps}
    assert service.module.state.last_state is last_state, "nor by the next"
    if last_state is LastState.HELD:
        assert {step.command for step in steps} == {DriveCommand.NOTHING}
        assert ArmingInhibit.LOST_TORQUE in {step.inhibit for step in steps}
        assert service.mode is Mode.DISARMED


@pytest.mark.parametrize("carries", [CARRIED, None])
@pytest.mark.parametrize("last_state", [LastState.NOTHING, LastState.HELD])
def test_what_holds_waits_for_a_planner_to_send(
    last_state: LastState, carries: Pair | None
) -> None:
    """Taken over with stand gains, beside a knee on soft ones, it tipped the robot.

    Unknown torques are not taken over, nor are they a reason to wait for a planner.
    """
    service = successor(last_state, carries=carries)
    steps = service.run(2 * NS_PER_S)
    waits = {ArmingInhibit.WAITING} if carries is not None else set()
    assert {step.command for step in steps} == {DriveCommand.NOTHING}
    assert {step.inhibit for step in steps} == {ArmingInhibit.NONE, *waits}
    assert service.mode is Mode.DISARMED
    assert service.law.state(service.controller, service.now_ns).drive == DriveStatus.HOLDING
    assert service.module.leaves_holding, "should it end before it has taken the drive over"
    if carries is None:
        service.lead(100)
        assert service.mode is Mode.DISARMED
        return
    service.lead(2, hold=True)
    assert service.mode is Mode.HOLD
    assert service.law.state(service.controller, service.now_ns).drive == DriveStatus.ARMED
    service.lead(hold=True)
    assert service.module.state.tries == 1, "it counts as asked once"


@pytest.mark.parametrize("last_state", [LastState.NOTHING, LastState.HELD])
@pytest.mark.parametrize("k_p", [(600.0, 800.0), (900.0, 12.0)])
def test_it_is_taken_over_with_the_commands_gains_and_the_torque_that_it_carries(
    last_state: LastState, k_p: Pair
) -> None:
    service = successor(last_state)
    service.run(100 * NS_PER_MS)
    told = {"hold": True, "k_p": k_p, "k_d": (40.0, 3.0)}
    listens, takes_over = service.lead(2, **told)
    assert listens.target is None
    assert takes_over.target is not None
    assert takes_over.target.torque == pytest.approx(CARRIED)
    at = motor_from_joint(service.q, service.gear_ratio)
    assert takes_over.target.pos_turns == pytest.approx(at)
    setpoint = service.controller.law.current
    assert (setpoint.k_p, setpoint.k_d) == (k_p, told["k_d"])
    assert setpoint.q_ref == pytest.approx(service.q)
    last = joint_torque(CARRIED, service.gear_ratio)
    assert service.controller.tau == pytest.approx(last)
    for _ in range(250):
        service.lead(**told)
        tau = service.controller.tau
        assert tau == pytest.approx(last, abs=0.6)
        last = tau
    risen = service.controller.law.current
    assert risen.k_p[1] == k_p[1], "theta of a knee as soft as the other knee's"


def test_what_found_nothing_or_let_go_leaves_nothing_holding() -> None:
    assert not DriveManager(ROBOT, "knee_left").leaves_holding
    service = successor(LastState.HELD)
    service.run(ARM_EVERY_NS)
    assert service.module.leaves_holding
    service.status = DriveStatus.IDLE
    service.run(2 * ARM_EVERY_NS)
    assert service.mode is Mode.DISARMED
    assert not service.module.leaves_holding


def test_after_a_stop_a_drive_that_holds_is_taken_over_and_sinks() -> None:
    """Without a planner too: in HOLD it would be the one strut while five sink."""
    service = successor(LastState.DAMP)
    before = joint_torque(CARRIED, service.gear_ratio)
    first = service.run(20 * NS_PER_MS)[0].event
    assert service.mode is Mode.DAMP
    assert first is not None
    assert first.mode_after == Mode.HOLD, "first it is taken over"
    assert service.controller.tau == pytest.approx(before, abs=2.0)
    service.run(round(ROBOT.joint_service.damp_fade_s) * NS_PER_S)
    assert service.controller.tau == pytest.approx((before[0], 0.0), abs=1e-6)
    assert service.module.state.last_state is LastState.DAMP


@pytest.mark.parametrize("unknown", ["silent", "LOST", "HOLDING"])
def test_an_emergency_stop_waits_until_the_drive_is_known(unknown: str) -> None:
    """A law made of a joint that was never seen would pull it to zero."""
    status = DriveStatus.LOST if unknown == "LOST" else DriveStatus.ARMED
    service = successor(LastState.NOTHING, status, carries=None)
    silent = unknown == "silent"
    steps = [service.cycle(estop=True, silent=silent)]
    steps += [service.cycle(silent=silent) for _ in range(100)]
    assert service.mode is Mode.DISARMED
    assert {step.command for step in steps} == {DriveCommand.NOTHING}
    service.status, service.carries = DriveStatus.ARMED, CARRIED
    service.run(2 * service.cycle_ns)
    assert service.mode is Mode.DAMP
    controller = service.controller
    assert controller.law.current.q_ref == pytest.approx(service.q)
    assert controller.tau == pytest.approx(joint_torque(CARRIED, service.gear_ratio), abs=2.0)


@pytest.mark.parametrize("last_state", [LastState.NOTHING, LastState.HELD])
def test_a_drive_is_armed_only_once_it_is_zeroed(last_state: LastState) -> None:
    service = successor(last_state, DriveStatus.UNZEROED)
    assert DriveCommand.ARM not in orders(service, NS_PER_S)
    assert service.law.state(service.controller, service.now_ns).drive == DriveStatus.UNZEROED
    service.status = DriveStatus.IDLE
    assert DriveCommand.ARM in orders(service, ARM_EVERY_NS + 10 * NS_PER_MS)


# ---- a service's process, and the file that outlives it

Start = Callable[[], Rig]


@pytest.fixture
def start(tmp_path: Path) -> Start:
    """Return how a service of MODULE is started, over a new drive."""
    return lambda: Rig(ROBOT, RearmGuard(tmp_path, MODULE))


@pytest.mark.parametrize("asked", [True, False])
def test_a_crashed_service_arms_only_if_asked_to(start: Start, tmp_path: Path, asked: bool) -> None:
    dead = start()
    dead.run(10)
    assert dead.drive.armed == 1
    if asked:
        clear(tmp_path, MODULE)
    after = start()
    after.drive.status = DriveStatus.ERROR  # one axis let go in between
    after.run(1000)
    assert after.drive.armed == int(asked)
    assert RearmGuard(tmp_path, MODULE).read() is LastState.HELD, "it holds, or has held"


@pytest.mark.parametrize("by", ["memory", "the bus", "silence"])
def test_a_stop_acts_at_once_for_good_and_outlives_its_service_until_a_person_asks_for_it(
    start: Start, tmp_path: Path, by: str
) -> None:
    rig, source = start(), "xrl estop by anna"
    rig.run(20)
    assert rig.mode is Mode.HOLD
    if by == "memory":
        request_stop(tmp_path, MODULE, source)
    elif by == "the bus":
        rig.estops.waiting.append(Estop(t_ns=0, seq=1, source=source))
    else:
        Pendant(tmp_path, [MODULE]).beat()
    rig.run(1000 if by == "silence" else 1)
    assert rig.mode is Mode.DAMP
    assert stop_source(tmp_path, MODULE) == (PENDANT if by == "silence" else source)
    rig.run(1000)
    assert rig.mode is Mode.DAMP
    crashed = start()
    crashed.run(20)
    assert crashed.mode in (Mode.DISARMED, Mode.DAMP, Mode.FAULT)
    assert crashed.drive.armed == 0, "nobody has asked for it"
    clear(tmp_path, MODULE)
    asked_for = start()
    asked_for.run(20)
    assert asked_for.mode is Mode.HOLD


@pytest.mark.parametrize(
    ("laid_down", "mode"), [(True, Mode.HOLD), (False, Mode.DAMP)], ids=["laid down", "left"]
)
def test_a_pendant_of_before_is_missed_unless_it_was_laid_down(
    start: Start, tmp_path: Path, laid_down: bool, mode: Mode
) -> None:
    """The pendant beats before the service starts, and falls silent later."""
    RearmGuard(tmp_path, MODULE)
    pendant = Pendant(tmp_path, MODULES)
    pendant.beat()
    process = start()
    silent_cycles = round(ROBOT.joint_service.pendant_ms / 2.0)
    for _ in range(3):
        process.run(silent_cycles)
        assert process.mode is Mode.HOLD
        pendant.beat()
    process.run(silent_cycles)
    assert process.mode is Mode.HOLD
    if laid_down:
        pendant.lay_down()
        process.run(2 * silent_cycles)
    process.run(2)
    assert process.mode is mode
    pendant.beat()
    process.run(10)
    assert process.mode is mode, "nor does it rise again by itself"


# ---- when a pendant is lost: a rule for each joint service


def silent(watch: PendantWatch, beats: int, from_ns: int, cycles: int) -> int:
    """Run cycles of 2 ms with the same count; return when the last was."""
    for cycle in range(1, cycles + 1):
        watch.is_lost(from_ns + cycle * 2 * NS_PER_MS, beats)
    return from_ns + cycles * 2 * NS_PER_MS


def test_a_pendant_is_lost_once_it_has_been_silent_for_longer_than_it_may() -> None:
    watch = PendantWatch(100.0)
    assert watch.lost is False
    now_ns = silent(watch, 0, 10**12, 1000)
    assert not watch.lost, "one that was never heard is not missed"
    for beats in (1, 2):
        now_ns = silent(watch, beats, now_ns, 1 + 50)
        assert not watch.lost
        now_ns = silent(watch, beats, now_ns, 1)
        assert watch.lost
    assert not watch.is_lost(now_ns + 1, 3), "it is heard again: what was stopped stays so"
    silent(watch, 3, now_ns, 60)
    assert watch.lost
    silent(watch, 0, now_ns, 1000)
    assert not watch.lost, "laid down"


def test_where_the_whole_machine_stood_still_no_process_was_silent() -> None:
    watch = PendantWatch(100.0)
    now_ns = silent(watch, 1, 10**12, 10)
    assert not watch.is_lost(now_ns + 10**10, 1)
    assert not watch.is_lost(now_ns + 10**10 + 2 * NS_PER_MS, 2)
    now_ns = silent(watch, 2, now_ns + 10**10, 10)
    for stall in range(1, 6):
        watch.is_lost(now_ns + stall * 10**9, 2)
    assert watch.lost, "in all it was: 5 times 20 ms"
