"""One planner tick without any I/O: who is heard, what is echoed, when it is time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.planner.intents import OperatorRequest
from services.planner.law.certificate import Margins
from services.planner.planner import EARLY_FRACTION, LATE_FRACTION, TICK_GAP_MAX_S, Planner
from services.planner.watch.engagement_fsm import WAITS_NS
from shared.arrays import Array
from shared.bus.messages import Attitude, JointCommand, Mode, PlannerMode, SplitSource
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import N_MODULES
from tests.imu.robots import with_imu
from tests.planner.states import (
    ROBOT,
    SESSION,
    START_NS,
    TICK_NS,
    closed,
    lead,
    receive_all,
    receive_but,
    requiring,
    state,
    wrench,
)


def joined(commands: list[JointCommand], name: str) -> Array:
    return np.concatenate([getattr(command, name) for command in commands])


def test_no_commands_before_the_states_of_all_six(planner: Planner, q: Array) -> None:
    for module in range(N_MODULES - 1):
        planner.receive_state(module, state(module, q), START_NS)
        assert planner.tick(START_NS + module) == []
    status = planner.status(START_NS + 10, 1.0)
    assert status.mode == PlannerMode.WAITING
    assert status.hold
    assert status.state_seq == (1, 1, 1, 1, 1, -1)
    assert status.state_age_ns == (10, 10, 10, 10, 10, -1)
    planner.receive_state(5, state(5, q), START_NS + 20)
    assert len(planner.tick(START_NS + 20)) == N_MODULES


def test_each_command_echoes_its_own_modules_stamp(planner: Planner, q: Array) -> None:
    receive_all(planner, q, START_NS)
    stamps = [command.echo_t_ns for command in planner.tick(START_NS)]
    assert stamps == [1000 * (module + 1) + 1 for module in range(N_MODULES)]
    planner.receive_state(3, state(3, q, seq=7), START_NS + 1)
    stamps = [command.echo_t_ns for command in planner.tick(START_NS + TICK_NS)]
    assert stamps == [1001, 2001, 3001, 4007, 5001, 6001]


def test_commands_count_up_and_name_the_session(planner: Planner, q: Array) -> None:
    for tick in range(5):
        now = START_NS + tick * TICK_NS
        receive_all(planner, q, now, seq=tick)
        told = {(each.session, each.t_ns, each.seq) for each in planner.tick(now)}
        assert told == {(SESSION, now, tick + 1)}
        assert planner.status(now, 0.0).seq == tick + 1


def test_all_hold_until_all_are_ready(planner: Planner, q: Array) -> None:
    for tick in range(5):
        now = START_NS + tick * TICK_NS
        receive_but(planner, 2, q, now, tick, ready=False)
        assert all(command.hold for command in planner.tick(now))
    receive_all(planner, q, now, seq=9)
    assert not any(command.hold for command in planner.tick(now + TICK_NS))


@pytest.mark.parametrize("silent", range(N_MODULES))
def test_all_hold_while_one_is_stale(planner: Planner, q: Array, silent: int) -> None:
    start = lead(planner, q)
    stale_ns = round(ROBOT.planner.state_stale_ms * NS_PER_MS)
    for now in (start + stale_ns, start + stale_ns + 1):
        for module in set(range(N_MODULES)) - {silent}:
            planner.receive_state(module, state(module, q, seq=50), now)
        holds = {command.hold for command in planner.tick(now)}
        assert holds == {now > start + stale_ns}
    assert planner.status(now, 0.0).mode == PlannerMode.WAITING


def test_commands_carry_each_modules_part_of_the_law(planner: Planner, q: Array) -> None:
    receive_all(planner, q, START_NS)
    commands = planner.tick(START_NS)
    np.testing.assert_allclose(joined(commands, "q_ref"), q, atol=1e-5)
    np.testing.assert_allclose(joined(commands, "v_ref"), 0.0, atol=1e-6)
    np.testing.assert_allclose(joined(commands, "tau_coupled"), 0.0, atol=0.02)
    assert np.abs(joined(commands, "tau_ff")).max() > 10.0
    assert joined(commands, "k_p").min() > 0.0
    assert joined(commands, "k_d").min() > 0.0


def test_it_leads_again_from_where_it_is(planner: Planner, q: Array) -> None:
    now = lead(planner, q) + NS_PER_S
    elsewhere = closed(1.0, x=-0.03, y=0.02, roll=0.04, pitch=0.4)
    receive_all(planner, elsewhere, now, seq=90)
    planner.tick(now)
    receive_all(planner, elsewhere, now, seq=91, ready=False, mode=int(Mode.HOLD))
    planner.tick(now + 200 * NS_PER_MS)
    receive_all(planner, elsewhere, now + 201 * NS_PER_MS, seq=92, ready=False, mode=int(Mode.HOLD))
    commands = planner.tick(now + 201 * NS_PER_MS)
    assert all(command.hold for command in commands)
    status = planner.status(now + 201 * NS_PER_MS, 0.0)
    np.testing.assert_allclose(
        status.p_ref, np.array(status.p) * (0.0, 0.0, 1.0, 0.0, 1.0, 0.0), atol=1e-9
    )


def test_six_new_states_are_due_once(planner: Planner, q: Array) -> None:
    last = lead(planner, q)
    half = round(EARLY_FRACTION * NS_PER_S / ROBOT.planner.rate_hz)
    receive_all(planner, q, last + 1, seq=50)
    assert not planner.is_due(last + half - 1)
    assert planner.is_due(last + half)
    planner.tick(last + 3 * NS_PER_MS)
    assert not planner.is_due(last + 6 * NS_PER_MS), "3 ms later, none new"


@pytest.mark.parametrize("heard", [0, 5])
def test_fewer_than_six_are_due_after_a_period_and_a_quarter(
    planner: Planner, q: Array, heard: int
) -> None:
    last = lead(planner, q)
    late = round(LATE_FRACTION * NS_PER_S / ROBOT.planner.rate_hz)
    for module in range(heard):
        planner.receive_state(module, state(module, q, seq=50), last + 1)
        planner.receive_state(module, state(module, q, seq=51), last + 2)
    assert not planner.is_due(last + late - 1)
    assert planner.is_due(last + late)


@pytest.mark.parametrize(
    ("ticks", "gap_ns", "seconds"),
    [(10, TICK_NS, 0.04), (1, 5 * NS_PER_S, TICK_GAP_MAX_S)],
    ids=["tick by tick", "after 5 s: one bounded step"],
)
def test_assist_rises_by_the_time_between_ticks_and_a_long_gap_is_not_integrated(
    planner: Planner, q: Array, ticks: int, gap_ns: int, seconds: float
) -> None:
    now = lead(planner, q)
    planner.receive_request(OperatorRequest(200.0))
    for tick in range(ticks):
        now += gap_ns
        receive_all(planner, q, now, seq=50 + tick)
        planner.tick(now)
    assist = planner.status(now, 0.0).assist_n
    assert assist == pytest.approx(ROBOT.assist.rate_max * seconds)


def test_a_status_holds_what_the_tick_saw(planner: Planner, q: Array) -> None:
    receive_all(planner, q, START_NS, seq=7)
    planner.receive_wrench(wrench(seq=33), START_NS + 1)
    planner.tick(START_NS + 2)
    status = planner.status(START_NS + 2, 123.0)
    assert (status.t_ns, status.session, status.tick_us) == (START_NS + 2, SESSION, 123.0)
    assert (status.mode, status.hold) == (PlannerMode.ALIGNING, True)
    assert (status.state_seq, status.state_age_ns, status.wrench_seq) == ((7,) * 6, (2,) * 6, 33)
    assert (status.p[0], status.p[4]) == pytest.approx((0.01, 0.1), abs=1e-6)
    assert status.p_ref == pytest.approx(status.p, abs=1e-9)
    assert status.closure == pytest.approx((0.0,) * 6, abs=1e-6)
    assert status.pdot == (0.0,) * 6
    assert status.ik_residual < 1e-6


def test_both_margins_are_told(planner: Planner, q: Array) -> None:
    now = lead(planner, q)
    receive_all(planner, q, now, seq=50)
    commands = planner.tick(now + 4 * NS_PER_MS)
    status = planner.status(now + 4 * NS_PER_MS, 0.0)
    assert {command.margin for command in commands} == {status.margin}
    assert {command.margin_onboard for command in commands} == {status.margin_onboard}
    assert status.split == SplitSource.SCHEDULE
    assert status.margin >= ROBOT.certificate.margin_min
    assert status.margin_onboard >= ROBOT.certificate.onboard_margin_min


def test_gains_that_fall_hold_at_once(planner: Planner, q: Array) -> None:
    """The mode follows a tick later; when the gains stand again it waits as after a drop-out."""
    now = lead(planner, q)
    split = planner._law.split
    least = split._margins_min
    seen = []
    wait_ns = WAITS_NS[1]
    for tick, (fails, after_ns) in enumerate(
        ((False, 0), (True, 0), (True, 0), (False, 0), (False, 0), (False, wait_ns), (False, 0))
    ):
        split._margins_min = Margins(1e9, 1e9) if fails else least
        now += 4 * NS_PER_MS + after_ns
        receive_all(planner, q, now, seq=50 + tick)
        commands = planner.tick(now)
        status = planner.status(now, 0.0)
        assert (status.split == SplitSource.UNCERTIFIED) == fails
        seen.append((PlannerMode(status.mode), {command.hold for command in commands}))
    assert seen == [
        (PlannerMode.LEADING, {False}),
        (PlannerMode.LEADING, {True}),
        (PlannerMode.UNCERTIFIED, {True}),
        (PlannerMode.UNCERTIFIED, {True}),
        (PlannerMode.ALIGNING, {True}),
        (PlannerMode.LEADING, {False}),
        (PlannerMode.LEADING, {False}),
    ]


def test_a_robot_that_nothing_holds_is_never_lead(q: Array) -> None:
    planner = Planner(requiring(ROBOT, K_required=(1e5,) * 6), SESSION)
    for tick in range(10):
        now = START_NS + tick * 4 * NS_PER_MS
        receive_all(planner, q, now, seq=tick)
        assert all(command.hold for command in planner.tick(now))
    status = planner.status(now, 0.0)
    assert status.mode == PlannerMode.UNCERTIFIED
    assert status.hold
    assert status.margin < ROBOT.certificate.margin_min


def test_a_status_before_any_state_is_finite(planner: Planner) -> None:
    status = planner.status(START_NS, 0.0)
    assert (status.mode, status.hold, status.wrench_seq) == (PlannerMode.WAITING, True, -1)
    assert status.state_seq == status.state_age_ns == (-1,) * 6
    assert np.isfinite([*status.p, *status.p_ref, *status.closure]).all()


def attitude(roll: float, seq: int, *, valid: bool = True) -> Attitude:
    up = (0.0, math.sin(roll), math.cos(roll))
    return Attitude(t_ns=0, seq=seq, up=up, rate=(0.0, 0.0, 0.0), valid=valid, age_ns=0)


@pytest.mark.parametrize(
    ("valid", "late_ms", "heeded"),
    [(True, 0.0, True), (True, 99.0, True), (True, 101.0, False), (False, 0.0, False)],
)
def test_an_attitude_is_heeded_while_it_is_fresh_and_valid(
    valid: bool, late_ms: float, heeded: bool
) -> None:
    q = closed(1.188)
    planner = Planner(with_imu(ROBOT, stale_ms=100.0), SESSION)
    receive_all(planner, q, START_NS)
    planner.receive_attitude(attitude(0.0, 1), START_NS)
    planner.tick(START_NS)
    before = planner.status(START_NS, 0.0)
    assert before.attitude_seq == 1
    planner.receive_attitude(attitude(0.05, 2, valid=valid), START_NS + 1)
    later = START_NS + 1 + round(late_ms * NS_PER_MS)
    receive_all(planner, q, later, seq=2)
    planner.tick(later)
    after = planner.status(later, 0.0)
    assert after.attitude_seq == 2
    assert (after.slope != before.slope) is heeded


def test_an_old_wrench_eases_nothing() -> None:
    """A hand that pulled with 60 N as the harness fell silent would pull for ever."""
    q = closed(1.188)
    heard, deaf = Planner(ROBOT, SESSION), Planner(ROBOT, SESSION)
    now_ns = lead(heard, q)
    assert lead(deaf, q) == now_ns
    heard.receive_wrench(wrench(60.0, t_ns=now_ns), now_ns)
    eased = []
    for seq in range(5, 400):
        now_ns += TICK_NS
        torques = []
        for planner in (heard, deaf):
            receive_all(planner, q, now_ns, seq)
            torques.append([c.tau_coupled for c in planner.tick(now_ns)])
        eased.append(float(np.abs(np.subtract(*torques)).max()))
    assert max(eased[:5]) > 0.1, "it was heard at first"
    assert eased[-1] < 1e-6
    assert now_ns - START_NS > NS_PER_S
