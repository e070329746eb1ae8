"""What a module orders of its drive: arming, after a freeze, and what the drive is left with."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import pytest

from services.joint.drive_manager import (
    ARM_EVERY_NS,
    ARM_TRIES,
    FORGET_EVERY_NS,
    GAP_NS,
    IDLE_EVERY_NS,
    LISTEN_NS,
    ArmingInhibit,
    DriveCommand,
    DriveManager,
    DriveManagerState,
)
from services.joint.drive_setpoint import INPUT_TORQUE_SHARE
from services.joint.neighbours import NeighbourView
from services.joint.sinking import DOUBT_NS
from shared.bus.messages import DriveStatus, Mode, Pair
from shared.can.cansimple import AxisError
from shared.clock import NS_PER_MS, NS_PER_S
from shared.state import copied
from tests.joint.helpers import ROBOT, LoopName, ModuleBench

MODES = (Mode.HOLD, Mode.TRACK, Mode.DAMP)
LOOPS: tuple[LoopName, ...] = ("onboard", "service")
MOVED: Pair = (0.05, -0.97)


@pytest.fixture
def bench() -> ModuleBench:
    return ModuleBench(ROBOT)


@pytest.fixture
def held(bench: ModuleBench) -> ModuleBench:
    """Return a module that holds."""
    bench.to(Mode.HOLD)
    return bench


def orders(bench: ModuleBench, lasting_ns: int) -> list[DriveCommand]:
    return [step.command for step in bench.run(lasting_ns)]


# ---- a service that was frozen goes on from what its drive carries (docs/drives.md)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("loop", LOOPS)
def test_after_a_freeze_the_drives_torque_goes_on_without_a_step(
    mode: Mode, loop: LoopName
) -> None:
    bench = ModuleBench(ROBOT, loop)
    bench.to(mode)
    bench.freeze(2 * NS_PER_S, MOVED)
    last = bench.carried()
    orders = []
    for _ in range(round(ROBOT.joint_service.blend_ms * NS_PER_MS / bench.cycle_ns) + 30):
        orders.append(bench.cycle().command)
        now = bench.carried()
        assert max(abs(b - a) for a, b in zip(last, now, strict=True)) < 0.7
        last = now
    listening = [DriveCommand.NOTHING] * round(LISTEN_NS / bench.cycle_ns)
    assert orders[: len(listening)] == listening, "what the link has queued is old"
    assert DriveCommand.NOTHING not in orders[len(listening) :]


@pytest.mark.parametrize("loop", LOOPS)
def test_at_last_it_holds_as_if_never_frozen(loop: LoopName) -> None:
    frozen, twin = ModuleBench(ROBOT, loop), ModuleBench(ROBOT, loop)
    for each in (frozen, twin):
        each.to(Mode.TRACK)
    frozen.freeze(NS_PER_S, MOVED)
    for share in (0.25, 0.5, 0.75, 1.0):  # a joint moves, and does not jump
        twin.q = tuple(a + share * (b - a) for a, b in zip((0.02, -1.0), MOVED, strict=True))
        twin.cycle()
    for each in (frozen, twin):
        each.run(700 * each.cycle_ns)
    assert frozen.mode is twin.mode is Mode.HOLD
    assert frozen.carried() == pytest.approx(twin.carried(), abs=1e-9)


@pytest.mark.parametrize("gap_ns", [GAP_NS - 2 * NS_PER_MS, GAP_NS + NS_PER_MS])
def test_a_gap_within_the_age_rule_goes_on_in_track_without_a_step(
    bench: ModuleBench, gap_ns: int
) -> None:
    """A shorter one is no freeze."""
    bench.to(Mode.TRACK)
    bench.freeze(gap_ns, (0.03, -0.98))
    carried = bench.carried()
    orders = [bench.lead(tau_coupled=(3.0, -4.0))[0].command for _ in range(20)]
    assert (orders[0] is DriveCommand.TARGET) is (gap_ns < GAP_NS)
    assert bench.carried() == pytest.approx(carried, abs=2.0)
    assert bench.mode is Mode.TRACK


def test_an_emergency_stop_and_a_lost_torque_that_came_meanwhile_are_obeyed_at_once(
    held: ModuleBench,
) -> None:
    held.freeze(NS_PER_S, MOVED)
    before = held.carried()
    held.cycle(estop=True)
    assert held.mode is Mode.DAMP
    held.run(10 * held.cycle_ns)
    assert held.carried() == pytest.approx(before, abs=5.0)
    held.freeze(NS_PER_S, MOVED)
    held.status = DriveStatus.IDLE
    assert held.cycle().command is DriveCommand.IDLE
    assert held.mode is Mode.FAULT


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("frozen_ns", [0, 3 * NS_PER_S])
def test_a_jump_is_believed_only_as_the_link_is_read_out_after_a_freeze(
    loop: LoopName, frozen_ns: int
) -> None:
    """The first sample is of the time before, the next is where the hand has led the joint."""
    bench = ModuleBench(ROBOT, loop)
    bench.to(Mode.HOLD)
    bench.now_ns += frozen_ns
    bench.cycle()
    bench.q = (0.02, -1.1)
    bench.run(100 * bench.cycle_ns)
    assert bench.mode is (Mode.HOLD if frozen_ns else Mode.FAULT)
    assert (bench.controller.estimate.q == pytest.approx(bench.q)) is (frozen_ns > 0)


def test_after_a_freeze_the_event_has_the_torques_carried(bench: ModuleBench) -> None:
    """Nothing is sent before the drive has sent, and it is listened to first."""
    bench.to(Mode.TRACK)
    bench.freeze(2 * NS_PER_S, MOVED)
    carried = bench.carried()
    silent = [bench.cycle(), *(bench.cycle(silent=True) for _ in range(20))]
    assert {step.command for step in silent} == {DriveCommand.NOTHING}
    event = silent[0].event
    assert (silent[0].torque, silent[0].target) == ((0.0, 0.0), None)
    assert silent[0].inhibit is ArmingInhibit.NONE
    assert event is not None
    assert (event.mode_before, event.mode_after) == (Mode.TRACK, Mode.HOLD)
    assert event.tau_before == pytest.approx(carried)
    assert event.tau_after == pytest.approx(carried, abs=1.0)
    assert event.tau_after == pytest.approx(bench.controller.tau)
    assert bench.cycle().command is DriveCommand.TARGET
    assert bench.carried() == pytest.approx(carried, abs=1.0)


@pytest.mark.parametrize("status", [DriveStatus.IDLE, DriveStatus.ERROR])
def test_uncontrolled_it_listens_to_nothing(bench: ModuleBench, status: DriveStatus) -> None:
    if status is DriveStatus.ERROR:
        bench.to(Mode.HOLD)
    else:
        bench.cycle(silent=True)
    bench.status = status
    bench.freeze(2 * GAP_NS, MOVED)
    for _ in range(3):
        bench.cycle(silent=status is DriveStatus.IDLE)
        assert bench.module.state.listen_until_ns == 0
    assert bench.mode in (Mode.FAULT, Mode.DISARMED)


# ---- arming


def test_a_drive_that_never_arms_is_asked_so_often_and_reported_once() -> None:
    bench, told = ModuleBench(ROBOT, obeys=False), []
    for _ in range((ARM_TRIES + 4) * ARM_EVERY_NS // bench.cycle_ns):
        step = bench.cycle()
        assert step.torque == (0.0, 0.0)
        if step.command is DriveCommand.ARM or step.inhibit is not ArmingInhibit.NONE:
            told.append((bench.now_ns, step.command, step.inhibit))
    assert [row[1:] for row in told] == [
        *[(DriveCommand.ARM, ArmingInhibit.NONE)] * ARM_TRIES,
        (DriveCommand.NOTHING, ArmingInhibit.REFUSED),
    ]
    assert {later[0] - sooner[0] for sooner, later in pairwise(told)} == {ARM_EVERY_NS}
    assert bench.mode is Mode.DISARMED


def marked(mark_turns: float = 40.0) -> ModuleBench:
    drive = msgspec.structs.replace(ROBOT.drive, zero_mark_turns=mark_turns)
    return ModuleBench(msgspec.structs.replace(ROBOT, drive=drive))


@pytest.mark.parametrize("mark_turns", [0.0, 0.5, 40.0])
@pytest.mark.parametrize(
    ("status", "error", "jump", "lacks"),
    [
        (DriveStatus.UNZEROED, 0, 0.0, True),
        (DriveStatus.ERROR, AxisError.ENCODER_FAILED, 0.0, True),
        (DriveStatus.ERROR, AxisError.MOTOR_FAILED, 0.0, False),
        (DriveStatus.ERROR, 0, 0.1, True),
    ],
)
def test_a_drive_that_may_lack_turns_is_idled_and_forgets_its_zero_after_each_heartbeat(
    mark_turns: float, status: DriveStatus, error: AxisError, jump: float,
    lacks: bool,
) -> None:  # fmt: skip
    """An encoder that reads 0 disarms its axis by overspeed, before three samples are rejected.

    Until the drive shows that it has no zero.
    """
    bench = marked(mark_turns)
    bench.to(Mode.HOLD)
    bench.status, bench.error, bench.q = status, error, (bench.q[0] + jump, bench.q[1])
    every = FORGET_EVERY_NS // bench.cycle_ns
    steps = bench.run(5 * FORGET_EVERY_NS)
    assert (bench.mode, steps[0].command) == (Mode.FAULT, DriveCommand.IDLE)
    forgets = [at for at, step in enumerate(steps) if step.command is DriveCommand.CLEAR_ZERO]
    if not lacks or not mark_turns:
        assert not forgets
    elif status is DriveStatus.ERROR and error:
        assert forgets == [every, 2 * every, 3 * every, 4 * every]
        assert steps[every].torque == (0.0, 0.0)
    else:
        assert min(forgets) >= every
    bench.status, bench.error = DriveStatus.UNZEROED, AxisError.NONE
    bench.cycle()
    assert status is DriveStatus.UNZEROED or DriveCommand.CLEAR_ZERO not in orders(bench, NS_PER_S)


def test_a_disarmed_drive_forgets_its_zero_if_its_encoder_fails_and_obeys_a_stop_at_once() -> None:
    """Where no drive is to be taken over."""
    bench = marked()
    bench.obeys = False
    bench.run(10 * bench.cycle_ns)
    bench.status, bench.error = DriveStatus.ERROR, AxisError.ENCODER_FAILED
    assert bench.cycle().command is DriveCommand.CLEAR_ZERO
    assert bench.mode is Mode.DISARMED
    bench.cycle(estop=True)
    assert bench.mode is Mode.DAMP


@pytest.mark.parametrize("zeroed", [True, False])
def test_an_idle_joint_that_jumps_is_armed_only_once_a_new_zero_explains_it(zeroed: bool) -> None:
    bench = marked()
    bench.status, bench.zero = DriveStatus.LOST, (0.25, 0.75)
    bench.cycle()
    bench.status, bench.obeys = DriveStatus.IDLE, False
    bench.cycle()
    bench.q, bench.zero = (bench.q[0] + 0.18, bench.q[1] + 0.18), None
    assert {step.command for step in bench.run(NS_PER_S)} == {DriveCommand.NOTHING}
    bench.zero = (0.5, 0.75) if zeroed else (0.25, 0.75)
    bench.cycle()
    found = {step.command for step in bench.run(NS_PER_S)}
    assert (DriveCommand.ARM in found) is zeroed
    assert (DriveCommand.CLEAR_ZERO in found) is not zeroed


def test_samples_that_jump_as_the_link_is_read_out_after_a_freeze_lack_no_turns() -> None:
    bench = marked()
    bench.zero = (0.25, 0.75)
    bench.to(Mode.HOLD)
    bench.zero = None
    bench.now_ns += 2 * GAP_NS
    bench.cycle()  # an old one
    bench.q = (bench.q[0] + 0.1, bench.q[1] + 0.1)
    bench.cycle()
    bench.zero = (0.25, 0.75)
    bench.cycle()
    bench.run(NS_PER_S // 10)
    assert not bench.controller.estimate.turns_lost
    assert bench.mode is Mode.HOLD


def test_what_the_neighbours_do_comes_through(bench: ModuleBench) -> None:
    bench.to(Mode.DAMP)
    assert bench.module.needs_neighbours
    for _ in range(2 * DOUBT_NS // bench.cycle_ns):
        bench.cycle(silent=True, estop=True, near=NeighbourView(sinks=False))
    assert bench.controller.law.stays


def test_a_module_knows_its_bus_and_its_motors_limit(held: ModuleBench) -> None:
    """N m of the motor: current limit times torque constant, not over it."""
    most = ROBOT.drive.current_lim * ROBOT.drive.torque_constant
    assert held.module._law._input_max == pytest.approx(INPUT_TORQUE_SHARE * most)
    for row in ROBOT.module:
        assert DriveManager(ROBOT, row.name).bus == row.bus


# ---- what a drive does that is left alone: its service has died, or its cable is out

SOFT_P: Pair = (120.0, 300.0)
SOFT_D: Pair = (4.0, 10.0)
OFF: Pair = (0.02, -0.03)
"""rad from the joint to its reference."""


def joint_gains(bench: ModuleBench) -> Pair:
    """Return the stiffness, N m/rad, and the damping, N m s/rad, of each axis, by its drive."""
    assert bench.target is not None
    scale = (2.0 * bench.gear_ratio) ** 2 / (4.0 * math.pi)
    (pos_gain, _), (vel_gain, _) = bench.target.pos_gain, bench.target.vel_gain
    return scale * pos_gain * vel_gain, scale * vel_gain


def soft_in_track(module: str) -> ModuleBench:
    """Bring a module to TRACK on gains far below HOLD's, off its reference and moving."""
    bench = ModuleBench(ROBOT, module=module)
    bench.q = (0.02, -1.0) if module.startswith("knee") else (0.02, 0.1)
    bench.until(Mode.HOLD, bench.cycle)
    soft = {"q_ref": (bench.q[0] + OFF[0], bench.q[1] + OFF[1]), "k_p": SOFT_P, "k_d": SOFT_D}
    bench.lead(800, **soft)
    assert bench.mode is Mode.TRACK
    bench.v = (0.1, -0.2)
    bench.lead(**soft)
    return bench


@pytest.mark.parametrize("module", ["ankle_right", "ankle_left", "knee_right", "hip_left"])
def test_only_an_ankles_drive_is_left_with_holds_gains(module: str) -> None:
    """With 4 N m s/rad on each ankle 7 of 26 pairs of pushes fell, all six services dead.

    At the sample it changes nothing: TRACK's law is the command's, to the last of its torque.
    """
    bench = soft_in_track(module)
    k_p, k_d = SOFT_P, SOFT_D
    if module.startswith("ankle"):
        k_p, k_d = ROBOT.hold_gains(module)
        assert min(k_p) > max(SOFT_P)
        assert min(k_d) > max(SOFT_D)
    assert joint_gains(bench) == pytest.approx((sum(k_p) / 2.0, sum(k_d) / 2.0), rel=0.03)
    law = [SOFT_P[i] * OFF[i] - SOFT_D[i] * bench.v[i] + ff for i, ff in enumerate((3.0, -25.0))]
    assert bench.carried() == pytest.approx(law, abs=1e-9)


@pytest.mark.parametrize("module", ["ankle_right", "knee_right"])
def test_a_drive_left_in_damp_goes_on_with_damps_own_gains(module: str) -> None:
    """A drive that is left sinks: with HOLD's gains it would be the one that does not."""
    bench = soft_in_track(module)
    bench.cycle(estop=True)
    bench.run(1000 * bench.cycle_ns)
    assert bench.mode is Mode.DAMP
    own = bench.controller.law.current
    wanted = (sum(own.k_p) / 2.0, sum(own.k_d) / 2.0)
    assert joint_gains(bench) == pytest.approx(wanted, rel=0.03)


@pytest.mark.parametrize("lost", [True, False])
@pytest.mark.parametrize("status", [DriveStatus.ERROR, DriveStatus.IDLE, DriveStatus.UNZEROED])
def test_a_drive_that_let_go_is_idled_again_and_again_and_never_armed(
    held: ModuleBench, status: DriveStatus, lost: bool
) -> None:
    """Its sibling went on pulling alone: on theta by what it pulled on phi."""
    if lost:
        held.status = DriveStatus.LOST
        assert set(orders(held, 200 * held.cycle_ns)) == {DriveCommand.NOTHING}, "it may hold still"
        assert held.mode is Mode.FAULT
    held.status = status
    found = orders(held, 3 * IDLE_EVERY_NS)
    assert held.mode is Mode.FAULT
    assert found[0] is DriveCommand.IDLE
    assert found.count(DriveCommand.IDLE) == 3, "the frame may have been lost"
    assert DriveCommand.ARM not in found


@pytest.mark.parametrize("back", [DriveStatus.ARMED, DriveStatus.HOLDING])
def test_a_lost_drive_that_is_back_holding_is_left(held: ModuleBench, back: DriveStatus) -> None:
    """It must find no torque of zero and no order to go idle."""
    for status in (DriveStatus.LOST, back):
        held.status = status
        assert {step.command for step in held.run(4 * NS_PER_S)} == {DriveCommand.NOTHING}
    assert held.mode is Mode.FAULT
    assert held.module.leaves_holding, "nor does ending its service idle it"


# ---- a module goes on from its snapshot, bit for bit


BEGINS = {
    "frozen": (Mode.HOLD, None),
    "stiffening": (Mode.HOLD, {"hold": True, "stiffen": True}),
    "shaking": (Mode.TRACK, {}),
    "phased": (Mode.TRACK, {"state_phase": 1}),
    "sinking": (Mode.DAMP, None),
}
"""What a module is in the middle of: its mode, and what it is sent."""


@pytest.mark.parametrize("begins", BEGINS)
@pytest.mark.parametrize("cycles", [0, 1, 5, 60])
def test_a_module_goes_on_from_its_snapshot_bit_for_bit_and_shares_nothing_with_it(
    begins: str, cycles: int
) -> None:
    bench, twin = ModuleBench(ROBOT), ModuleBench(ROBOT)
    mode, told = BEGINS[begins]
    bench.to(mode)
    if begins == "frozen":
        bench.freeze(NS_PER_S, MOVED)
    bench.v = (0.6, -0.3) if begins == "shaking" else bench.v
    bench.run(cycles * bench.cycle_ns) if told is None else bench.lead(3 + cycles, **told)
    snapshot = copied(bench.module.state)
    assert min(snapshot.controller.trips.mean) > 0.0 or begins != "shaking"
    assert min(snapshot.gains.stiffness, snapshot.gains.damping, snapshot.gains.changed_ns) > 0
    text = msgspec.json.encode(snapshot)
    read = msgspec.json.decode(text, type=DriveManagerState)
    twin.module.state = copied(read)
    assert twin.module.state == snapshot
    twin.now_ns, twin.q, twin.v, twin.status = bench.now_ns, bench.q, bench.v, bench.status
    for _ in range(200):
        assert bench.cycle() == twin.cycle()
        assert bench.law.is_state_due(bench.controller) is twin.law.is_state_due(twin.controller)
    assert bench.law.state(bench.controller, bench.now_ns) == twin.law.state(
        twin.controller, twin.now_ns
    )
    assert bench.module.state == twin.module.state
    assert msgspec.json.encode(snapshot) == msgspec.json.encode(read) == text
