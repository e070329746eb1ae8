"""Planner ticks: who is heard, what is echoed, when it is due; and its state is all there is."""

from __future__ import annotations

import math
import random
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest

from services.planner.intents import OperatorRequest
from services.planner.law.certificate import Margins
from services.planner.loop import FOLLOW_NS, POLL_NS, PlannerLoop, PlannerPorts
from services.planner.planner import (
    EARLY_FRACTION,
    LATE_FRACTION,
    TICK_GAP_MAX_S,
    Planner,
    PlannerState,
)
from services.planner.watch.engagement_fsm import WAITS_NS
from shared.arrays import Array
from shared.bus.messages import Attitude, DriveStatus, JointCommand, Mode, PlannerMode, SplitSource
from shared.clock import NS_PER_MS, NS_PER_S
from shared.joints import N_MODULES
from shared.state import copied
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
    ticked,
    wrench,
)


def joined(commands: list[JointCommand], name: str) -> Array:
    return np.concatenate([getattr(command, name) for command in commands])


def test_no_commands_before_the_states_of_all_six(planner: Planner, q: Array) -> None:
    status = planner.status(START_NS, 0.0)
    assert (status.mode, status.hold, status.wrench_seq) == (PlannerMode.WAITING, True, -1)
    assert status.state_seq == status.state_age_ns == (-1,) * 6
    for module in range(N_MODULES - 1):
        planner.receive_state(module, state(module, q), START_NS)
        assert planner.tick(START_NS + module) == []
    assert np.isfinite([*status.p, *status.p_ref, *status.closure]).all()
    status = planner.status(START_NS + 10, 1.0)
    assert (status.mode, status.hold) == (PlannerMode.WAITING, True)
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
    commands, _ = ticked(planner, q, START_NS)
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
    for seq in (91, 92):
        at_ns = now + (109 + seq) * NS_PER_MS
        held = {"ready": False, "mode": int(Mode.HOLD)}
        commands, status = ticked(planner, elsewhere, at_ns, seq, **held)
    assert all(command.hold for command in commands)
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
        _, status = ticked(planner, q, now, 50 + tick)
    assert status.assist_n == pytest.approx(ROBOT.assist.rate_max * seconds)


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
    commands, status = ticked(planner, q, lead(planner, q) + TICK_NS, 50)
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
        commands, status = ticked(planner, q, now, 50 + tick)
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


def test_a_robot_that_nothing_holds_is_never_led(q: Array) -> None:
    planner = Planner(requiring(ROBOT, K_required=(1e5,) * 6), SESSION)
    for tick in range(10):
        commands, status = ticked(planner, q, START_NS + tick * TICK_NS, tick)
        assert all(command.hold for command in commands)
    assert (status.mode, status.hold) == (PlannerMode.UNCERTIFIED, True)
    assert status.margin < ROBOT.certificate.margin_min


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


COURSES: dict[str, dict[str, Any]] = {
    "a module that stays disarmed": {"mode": int(Mode.DISARMED), "drive": int(DriveStatus.IDLE)},
    "another planner that leads": {"session": 99},
    "feet astray": {},
}


@pytest.mark.parametrize("name", COURSES)
def test_a_planner_goes_on_bit_for_bit(name: str) -> None:
    """It goes on counting, with the wish, the stance and the rival that it had."""
    changes, q = COURSES[name], closed(1.188, x=0.01, pitch=0.1)
    if name == "feet astray":
        q += 1e-2 * np.random.default_rng(4).normal(size=12)
    planner, twin = (Planner(with_imu(ROBOT), SESSION) for _ in range(2))
    planner.receive_request(OperatorRequest(0.0, (0.01, 0.0, 0.0, 0.02)))
    seen = []
    for tick in range(60):
        if tick == 40:
            text = msgspec.json.encode(planner.state)
            twin.state = msgspec.json.decode(text, type=PlannerState)
        now_ns = START_NS + tick * TICK_NS
        both = []
        for each in (planner, twin) if tick >= 40 else (planner,):
            each.receive_wrench(wrench(-0.5 * tick, seq=tick), now_ns)
            each.receive_attitude(attitude(1e-3 * tick, tick), now_ns)
            both.append(ticked(each, q, now_ns, tick, v=(0.01, -0.02), **changes))
        assert both[0] == both[-1]
        seen.append(both[0])
    status = seen[-1][1]
    assert status.shift_requested == (0.01, 0.0, 0.0, 0.02)
    if name == "a module that stays disarmed":
        assert [seen[40][0][0].stiffen, seen[-1][0][0].stiffen] == [False, True]
    elif name == "another planner that leads":
        assert "99" in status.why
    else:
        assert math.hypot(*status.stance[:3]) > 1e-3


def test_a_planner_that_may_park_goes_on_bit_for_bit() -> None:
    """It parks when it would have: how long it has stood still does not begin again."""
    robot = msgspec.structs.replace(ROBOT, park=msgspec.structs.replace(ROBOT.park, enabled=True))
    planner, twin, q = Planner(robot, SESSION), Planner(robot, SESSION), closed(0.95)
    for tick in range(43):
        now_ns = START_NS + tick * TICK_NS
        if tick == 40:
            assert planner.state.park.still_ns > 0
            twin.state = copied(planner.state)
        for each in (planner, twin) if tick >= 40 else (planner,):
            each.receive_wrench(wrench(-20.0, seq=tick), now_ns)
            ticked(each, q, now_ns, tick)
    assert msgspec.json.encode(twin.state) == msgspec.json.encode(planner.state)


PERIOD_NS = 4 * NS_PER_MS


class Looking:
    """A planner's loop in virtual time, and six states that are complete at given times."""

    def __init__(self, *, compares: bool = False) -> None:
        """Begin at 1 s."""
        planner = cast(Planner, SimpleNamespace(compares_arrivals=compares))
        self.loop = PlannerLoop(ROBOT, planner, cast(PlannerPorts, None))
        self.now_ns, self.polls, self._ticked_ns = NS_PER_S, 0, 0

    def tick_at(self, complete_ns: int, held_up_ns: int = 0) -> int:
        """Look until the states are complete, and tick; return how late that is, ns."""
        while self.now_ns < max(complete_ns, self._ticked_ns + PERIOD_NS // 2):
            self.now_ns = self.loop._next_look(self.now_ns, ticked=False)
            self.polls += 1
        self.now_ns += held_up_ns
        late_ns, self._ticked_ns = self.now_ns - complete_ns, self.now_ns
        self.now_ns = self.loop._next_look(self.now_ns, ticked=True)
        return late_ns


@pytest.mark.parametrize(("spread_ms", "looks"), [(0.2, 1.8), (0.5, 2.0), (2.0, 3.6)])
def test_states_wait_for_less_than_a_poll_in_the_mean_however_their_arrivals_spread(
    spread_ms: float, looks: float
) -> None:
    looking, dice = Looking(), random.Random(1)
    late = []
    for tick in range(500):
        jitter_ns = dice.randrange(round(spread_ms * NS_PER_MS))
        late.append(looking.tick_at(NS_PER_S + tick * PERIOD_NS + jitter_ns))
    assert sum(late[20:]) / len(late[20:]) < POLL_NS
    assert looking.polls < looks * 500, "between two ticks it rests"


@pytest.mark.parametrize("earlier_ms", [0.5, 2.0, 3.9])
def test_states_that_come_earlier_than_expected_wait_for_at_most_15_ticks(
    earlier_ms: float,
) -> None:
    looking = Looking()
    for tick in range(50):
        looking.tick_at(NS_PER_S + tick * PERIOD_NS)
    begun_ns = NS_PER_S + 50 * PERIOD_NS - round(earlier_ms * NS_PER_MS)
    late = [looking.tick_at(begun_ns + tick * PERIOD_NS) for tick in range(50)]
    assert max(late[15:]) <= 2 * POLL_NS + FOLLOW_NS


def test_while_arrivals_are_compared_it_does_not_rest() -> None:
    looking = Looking(compares=True)
    looking.tick_at(NS_PER_S)
    assert looking.loop._next_look(looking.now_ns, ticked=True) == looking.now_ns + POLL_NS
