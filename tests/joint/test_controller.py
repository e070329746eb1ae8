"""One cycle of a controller: power-up, TRACK, hand-over, what it tells and remembers."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from services.joint.controller import CycleResult, JointController, row_of
from services.joint.differential import limits_of
from services.joint.drivers.base import DriveReading
from services.joint.neighbours import SILENT_NS, NeighbourRow, NeighbourView
from shared.bus.messages import Cause, DriveStatus, JointCommand, Mode, Pair, Refusal
from shared.clock import NS_PER_MS, NS_PER_S
from tests.joint.helpers import ROBOT, SESSION, T0, Bench, command, with_service

K_P_STAND, K_D_STAND = (900.0, 1500.0), (30.0, 30.0)
"""[stand.knee] of this folder's robot, as the bench is a knee."""


@pytest.fixture
def bench() -> Bench:
    return Bench(ROBOT)


def pd(sent: JointCommand, q: Pair, v: Pair, age_s: float = 0.0) -> npt.NDArray[np.float64]:
    """Return the torque of a command at an age, told without the law under test."""
    q_ref = np.add(sent.q_ref, np.multiply(sent.v_ref, age_s))
    tau_ff = np.add(sent.tau_ff, np.multiply(sent.dtau_ff, age_s))
    spring = np.multiply(sent.k_p, q_ref - q)
    damper = np.multiply(sent.k_d, np.subtract(sent.v_ref, v))
    tau: npt.NDArray[np.float64] = spring + damper + tau_ff + np.array(sent.tau_coupled)
    return tau


@pytest.mark.parametrize("status", [DriveStatus.IDLE, DriveStatus.LOST, DriveStatus.ERROR])
def test_power_up_holds_the_measured_pose_once_the_drive_is_armed_and_not_before(
    bench: Bench, status: DriveStatus
) -> None:
    bench.status = status
    for result in bench.run(50, fresh=True):
        assert result == CycleResult((0.0, 0.0), None)
    assert bench.mode is Mode.DISARMED
    bench.q, bench.status = (0.1, -1.5), DriveStatus.ARMED
    result = bench.cycle()
    assert result.tau == pytest.approx((0.0, 0.0))
    assert result.event is not None
    assert (result.event.mode_before, result.event.mode_after) == (Mode.DISARMED, Mode.HOLD)
    assert result.event.cause == Cause.DRIVE_ARMED
    bench.q, bench.v = (0.11, -1.52), (0.1, -0.2)
    expected = (-900.0 * 0.01 - 45.0 * 0.1, 1500.0 * 0.02 + 25.0 * 0.2)
    assert bench.run(20)[-1].tau == pytest.approx(expected)


def test_track_gives_the_commands_torque_at_its_age_up_to_thirty_milliseconds(bench: Bench) -> None:
    rates = {"v_ref": (0.1, -0.2), "dtau_ff": (30.0, -60.0), "tau_coupled": (4.0, -3.0)}
    bench.to_track(**rates)
    sent = bench.fresh(**rates)
    bench.v = (0.03, -0.05)
    for cycle in range(25):
        tau = bench.cycle(sent if cycle == 0 else None).tau
        age_s = (bench.now_ns - sent.echo_t_ns) / NS_PER_S
        assert age_s == pytest.approx(0.002 * (cycle + 1))
        expected = pd(sent, bench.q, bench.v, min(age_s, 0.030))
        np.testing.assert_allclose(tau, expected, atol=1e-9)
    assert bench.mode is Mode.TRACK


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 1.0])
def test_track_blends_in_over_its_blend_time(share: float) -> None:
    bench = Bench(ROBOT)
    bench.to_hold()
    bench.q = (0.03, -1.02)
    first = bench.until(Mode.TRACK, lambda: bench.cycle(bench.fresh()))
    assert first is not None
    held = first.tau
    entered_ns, blend_ns = bench.now_ns, ROBOT.joint_service.blend_ms * NS_PER_MS
    while bench.now_ns - entered_ns < share * blend_ns:
        bench.cycle(bench.fresh())
    share = min(1.0, (bench.now_ns - entered_ns) / blend_ns)  # to the whole cycle
    fresh = pd(command(), bench.q, bench.v)
    assert np.linalg.norm(fresh - held) > 5.0, "nothing to blend"
    tau = bench.controller.tau
    np.testing.assert_allclose(tau, (1.0 - share) * np.array(held) + share * fresh, atol=1e-6)


SWING, OMEGA = 0.02, 5.0  # rad, rad/s: the references' motion

COUPLED: Pair = (12.0, -9.0)


def moving(bench: Bench, *, hold: bool = False) -> JointCommand:
    """Return a command whose references move as in a squat."""
    phase = OMEGA * (bench.now_ns - T0) / NS_PER_S
    swing, rate = SWING * math.sin(phase), SWING * OMEGA * math.cos(phase)
    return bench.fresh(
        q_ref=(swing, -1.0 + swing), v_ref=(rate, rate), tau_coupled=COUPLED, hold=hold
    )


def largest_step(reach: float) -> float:
    """Return what the ramps allow from one cycle to the next, N m, at most `reach` rad off."""
    service = ROBOT.joint_service
    dt_ms = 1e3 / service.rate_hz
    k_p, k_d, v_ref = max(K_P_STAND), 50.0, SWING * OMEGA
    coupled_out = (max(map(abs, COUPLED)) + k_d * v_ref) * dt_ms / service.coupled_ramp_ms
    apart = k_p * 2.0 * reach + 2.0 * k_d * v_ref + max(map(abs, COUPLED)) + 25.0
    blended = apart * dt_ms / service.blend_ms
    references = (k_p * v_ref + k_d * SWING * OMEGA**2) * 2.0 * dt_ms / 1e3
    return coupled_out + blended + references


scripts = st.lists(
    st.tuples(st.sampled_from(["fresh", "hold", "silent"]), st.integers(1, 60)),
    min_size=1,
    max_size=12,
)

FIG_7 = [("fresh", 200), ("silent", 40), ("fresh", 300), ("hold", 30), ("fresh", 60)]


def play(bench: Bench, script: list[tuple[str, int]]) -> tuple[list[Pair], set[tuple[Mode, Mode]]]:
    """Run a script of commands; return every cycle's torque and the changes of mode."""
    bench.to_hold()
    taus, changes = [bench.controller.tau], set()
    for kind, cycles in script:
        for _ in range(cycles):
            sent = moving(bench, hold=kind == "hold") if kind != "silent" else None
            result = bench.cycle(sent)
            taus.append(result.tau)
            if result.event is not None:
                event = result.event
                changes.add((Mode(event.mode_before), Mode(event.mode_after)))
    return taus, changes


@given(script=scripts)
@example(script=FIG_7)
def test_torque_makes_no_larger_step_than_the_ramps_allow(script: list[tuple[str, int]]) -> None:
    quick = with_service(ROBOT, engage_after_ms=10.0, engage_after_max_ms=20.0)
    taus, changes = play(Bench(quick), script)
    steps = np.abs(np.diff(np.array(taus), axis=0))
    most = largest_step(reach=0.02 + SWING)
    assert steps.max() <= most
    assert most < 5.0 < max(map(abs, COUPLED)), "the bound bites"
    if script == FIG_7:
        assert {(Mode.HOLD, Mode.TRACK), (Mode.TRACK, Mode.HOLD)} <= changes


def test_hold_freezes_references_and_drops_the_coupled_torque_over_its_ramp(bench: Bench) -> None:
    sent = {"tau_coupled": COUPLED, "k_p": K_P_STAND, "k_d": K_D_STAND}
    bench.to_track(**sent)
    before = np.array(bench.controller.tau)
    bench.cycle(bench.fresh(hold=True, **sent))
    for cycles, dropped in ((0, 0.0), (5, 0.5), (400, 1.0)):
        bench.run(cycles)
        left = before - dropped * np.array(COUPLED)
        np.testing.assert_allclose(bench.controller.tau, left, atol=1e-9)


@pytest.mark.parametrize(
    ("module", "theta_rises"), [("ankle_left", True), ("knee_left", False), ("hip_left", False)]
)
def test_in_hold_ankles_and_every_phi_stiffen_and_the_rest_stays_as_it_was_certified(
    module: str, theta_rises: bool
) -> None:
    bench = Bench(ROBOT, module)
    bench.q = (0.02, -0.3)  # inside each kind's limits
    sent = {"k_p": (100.0, 200.0), "k_d": (1.0, 1.0), "q_ref": bench.q}
    bench.to_track(**sent)
    bench.cycle(bench.fresh(hold=True, **sent))
    before = np.array(bench.run(400)[-1].tau)
    bench.q = (0.03, -0.31)
    change = np.array(bench.run(50)[-1].tau) - before
    phi, theta = ROBOT.stand_gains(module).k_p
    expected = (-0.01 * phi, 0.01 * (theta if theta_rises else 200.0))
    np.testing.assert_allclose(change, expected, atol=1e-9)


def test_a_new_session_in_track_makes_no_step_in_the_torque(bench: Bench) -> None:
    """Two planners run and the first dies: the second one's references are its own."""
    bench.to_track()
    bench.run(24)
    next_ns, timing = bench.now_ns + bench.cycle_ns, bench.law.timing
    assert (bench.mode, bench.controller.failsafe.is_fresh(next_ns, timing)) == (Mode.TRACK, False)
    taus = [bench.controller.tau]
    for _ in range(20):
        sent = bench.fresh(session=SESSION + 1, q_ref=(0.02, -0.97))
        taus.append(bench.cycle(sent).tau)
    assert np.abs(np.diff(np.array(taus), axis=0)).max() < 5.0  # docs/results.md#targets


def test_late_cycles_are_counted_beyond_twice_the_period(bench: Bench) -> None:
    bench.to_hold()
    period_ns, late = bench.cycle_ns, []
    for after_ns in (period_ns, 2 * period_ns, 2 * period_ns + 1, 1, 10 * period_ns, period_ns):
        bench.cycle(after_ns=after_ns)
        late.append(bench.law.state(bench.controller, bench.now_ns).late)
    assert late == [0, 0, 1, 1, 2, 2]


def test_a_stalled_drive_tracks_fresh_commands_and_keeps_the_failsafe_going(bench: Bench) -> None:
    bench.to_track()
    for _ in range(50):
        bench.cycle(bench.fresh(), stalled=True)
    assert bench.mode is Mode.TRACK
    events = [bench.cycle(stalled=True).event for _ in range(26)]
    assert [event.cause for event in events if event is not None] == [Cause.COMMAND_STALE]
    assert bench.controller.estimate.q == pytest.approx(bench.q)
    event = bench.cycle(stalled=True, estop=True).event
    assert event is not None
    assert (event.mode_before, event.mode_after) == (Mode.HOLD, Mode.DAMP)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_reading_that_is_no_number_lets_out_no_torque_that_is_none(
    bench: Bench, bad: float
) -> None:
    bench.to_track()
    before = bench.controller.tau
    reading = DriveReading(bench.now_ns, (bad, 0.0), (0.0, bad), DriveStatus.ARMED, 0)
    bench.now_ns += bench.cycle_ns
    assert bench.law.step(bench.controller, bench.now_ns, reading, None, False).tau == before


def test_a_state_holds_what_the_cycle_saw_and_did(bench: Bench) -> None:
    bench.to_track()
    bench.v = (0.1, -0.1)
    heat = bench.controller.heat
    heat.shown, heat.left_s = (61.5, 48.0), 93.5
    sent = bench.fresh(seq=900, state_phase=1)
    bench.now_ns += bench.cycle_ns
    reading = msgspec.structs.replace(bench.reading(), supply_v=23.7)
    bench.law.step(bench.controller, bench.now_ns, reading, sent, estop=False)
    state = bench.law.state(bench.controller, bench.now_ns)
    assert (state.celsius, state.heat_left_s) == ((61.5, 48.0), 93.5)
    assert (state.supply_v, state.state_phase) == (23.7, 1)
    bench.cycle(command(seq=1, echo_t_ns=bench.now_ns))
    state = bench.law.state(bench.controller, bench.now_ns)
    assert state.t_ns == bench.now_ns
    assert state.q == pytest.approx(bench.q)
    assert state.v == pytest.approx(bench.v)
    assert state.tau == bench.controller.tau
    assert (state.mode, state.ready) == (Mode.TRACK, True)
    assert (state.cause, state.stiffened) == (Cause.COMMANDS_FRESH, False)
    assert (state.session, state.command_seq) == (SESSION, 900)
    assert state.age_ns == bench.now_ns - sent.echo_t_ns == 2 * bench.cycle_ns
    assert (state.refused, state.dropouts, state.late) == (1, 0, 0)
    assert (state.refusal, state.refused_session) == (Refusal.NOT_NEWER, SESSION)
    assert state.cycle == bench.controller.cycle > 400


def test_what_the_drive_tells_of_its_heat_is_heard(bench: Bench) -> None:
    bench.to_hold()
    warm = {"fet_celsius": (71.0, 35.0), "motor_celsius": (30.0, 90.0)}
    told = msgspec.structs.replace(bench.reading(), **warm)
    heat, before = bench.controller.heat, bench.controller.heat.winding
    bench.law.step(bench.controller, bench.now_ns + bench.cycle_ns, told, None, estop=False)
    assert heat.stage == (71.0, 35.0)
    assert heat.winding[0] < before[0] == before[1] < heat.winding[1]


def test_a_state_before_any_command_is_marked_so_and_states_count_up(bench: Bench) -> None:
    first = bench.law.state(bench.controller, bench.now_ns)
    assert (first.seq, first.cause, first.stiffened) == (1, 0, False)
    bench.to_hold()
    state = bench.law.state(bench.controller, bench.now_ns)
    assert (state.age_ns, state.session, state.command_seq) == (-1, 0, -1)
    assert (state.seq, state.cycle, state.ready) == (2, 1, False)
    bench.now_ns += bench.cycle_ns
    failed = msgspec.structs.replace(bench.reading(), status=DriveStatus.ERROR, error=0x40)
    bench.law.step(bench.controller, bench.now_ns, failed, None, False)
    state = bench.law.state(bench.controller, bench.now_ns)
    assert (state.seq, state.cycle, state.drive_error) == (3, 2, 0x40)


@pytest.mark.parametrize("mode", [Mode.DISARMED, Mode.DAMP, Mode.FAULT])
def test_a_module_that_cannot_track_does_not_report_ready(bench: Bench, mode: Mode) -> None:
    """JointState.ready: fresh for long enough to track, were `hold` lifted."""
    bench.to(mode)
    bench.run(100, fresh=True, hold=True)
    assert (bench.mode, bench.law.state(bench.controller, bench.now_ns).ready) == (mode, False)


def test_an_event_holds_the_torque_on_both_sides_of_the_change(bench: Bench) -> None:
    bench.to_track(tau_coupled=COUPLED)
    before = bench.controller.tau
    result = bench.cycle(bench.fresh(hold=True))
    event = result.event
    assert event is not None
    assert (event.tau_before, event.tau_after) == (before, result.tau)
    assert (event.t_ns, event.age_ns, event.seq) == (bench.now_ns, bench.cycle_ns, 3)
    assert (event.mode_before, event.mode_after) == (Mode.TRACK, Mode.HOLD)
    assert event.cause == Cause.HOLD_ALL


@pytest.mark.parametrize("axis", [0, 1])
def test_a_joint_is_inside_up_to_its_soft_stop(axis: int) -> None:
    limits = limits_of(ROBOT, "knee_right")
    low, high = (limits.phi, limits.theta)[axis]
    law = JointController(ROBOT, "knee_right")
    controller = law.start()
    for angle, inside in ((low - 1e-6, False), (low, True), (high, True), (high + 1e-6, False)):
        at = [0.5 * sum(limits.phi), 0.5 * sum(limits.theta)]
        at[axis] = angle
        controller.estimate.q = (at[0], at[1])
        assert law.inside_limits(controller) is inside


def test_neighbours_are_given_the_joints_position_and_state(bench: Bench) -> None:
    """And told of a drive that is silent."""
    assert not row_of(bench.controller, bench.now_ns + SILENT_NS + 1).silent, "it is disarmed"
    bench.v = (0.3, -0.2)
    bench.to_hold()
    at = (pytest.approx(bench.q[1]), pytest.approx(-0.2))
    assert row_of(bench.controller, bench.now_ns) == NeighbourRow(bench.now_ns, *at, Mode.HOLD, 0)
    assert not row_of(bench.controller, bench.now_ns + SILENT_NS).silent
    assert row_of(bench.controller, bench.now_ns + SILENT_NS + 1).silent
    for _ in range(201):
        bench.cycle(estop=True, near=NeighbourView(sinks=False))
    assert row_of(bench.controller, bench.now_ns)[3:] == (Mode.DAMP, 1, 0)


def test_a_module_that_holds_with_all_it_has_reports_it_from_the_first_cycle(bench: Bench) -> None:
    for stiffened_ns, stiffened in ((0, False), (1, True)):
        bench.controller.law.stiffened_ns = stiffened_ns
        assert bench.law.state(bench.controller, bench.now_ns).stiffened is stiffened
