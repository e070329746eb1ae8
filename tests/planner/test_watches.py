"""What the planner watches: another planner, limp modules, the harness, heat and the supply."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.failsafe import Failsafe, timing_of
from services.planner.law.closed_reference import Toward
from services.planner.law.load import LoadState
from services.planner.planner import Planner
from services.planner.watch.engagement_fsm import AGAIN_NS, DISARMED_NS, LimpLegWatch, RivalWatch
from services.planner.watch.plausible import AFTER_S, CHANGE_MAX, HarnessTrust
from services.planner.watch.plausible import EASE_S as TRUST_EASE_S
from services.planner.watch.reserves import (
    EASE_S,
    HAND_MAX,
    POLE_S,
    RECOVERED_V,
    REST_S,
    RESTED_ON,
    SHED_RATE,
    HeatDecision,
    HeatWatch,
    HeatWatchState,
    SupplyState,
    SupplyWatch,
)
from shared.arrays import Array
from shared.bus.messages import (
    DriveStatus,
    HeatAction,
    JointState,
    Mode,
    PlannerMode,
    Refusal,
    Tare,
)
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import SupplyConfig
from shared.joints import MODULE_INDEX, MODULES, N_MODULES, kind_of
from shared.robot.hold_rules import Support
from tests.messages import all_states
from tests.planner.states import (
    DT,
    ROBOT,
    SESSION,
    START_NS,
    STILL,
    TICK_NS,
    Kept,
    lead,
    receive_but,
    states,
    ticked,
)

OWN, OTHER = 7, 9
AGE_MAX_NS = 50 * NS_PER_MS
LATE_NS = AGE_MAX_NS + 1
each_module = pytest.mark.parametrize("module", MODULES)


# ---- another planner


def following(*sessions: int, age_ns: int = 2 * NS_PER_MS) -> list[JointState]:
    told = {"age_ns": age_ns, "refusal": 0, "refused_session": 0}
    rows = [SimpleNamespace(session=session, **told) for session in sessions]
    return cast("list[JointState]", rows)


@pytest.mark.parametrize(
    ("rows", "own", "yields"),
    [
        pytest.param(following(*[OTHER] * 6), OWN, True, id="a newcomer"),
        pytest.param(following(*[OWN] * 5, OTHER), OWN, False, id="one who leads five"),
        pytest.param(following(*[0] * 6), OWN, False, id="modules that follow nobody"),
        pytest.param(following(OWN, OWN, age_ns=LATE_NS), OWN, False, id="its own are too old"),
        pytest.param(following(*[OTHER] * 6, age_ns=-1), OWN, False, id="no age"),
        pytest.param(following(*[OWN] * 6), OWN + 1, False, id="its own last session"),
        pytest.param(
            [*following(OWN, OWN), *following(*[OTHER] * 3, age_ns=LATE_NS)], OWN, False,
            id="one who leads and the other's are too old",
        ),
        # half a second: younger, the other may only have been held up
        pytest.param(following(*[OTHER] * 6, age_ns=AGAIN_NS), OWN, True, id="young"),
        pytest.param(following(*[OTHER] * 6, age_ns=AGAIN_NS + 1), OWN, False, id="old"),
    ],
)  # fmt: skip
def test_it_yields_to_whom_the_modules_follow(
    rows: list[JointState], own: int, yields: bool
) -> None:
    rival = RivalWatch()
    rival.advance(own, rows, AGE_MAX_NS)
    assert rival.yields is yields
    assert (str(OTHER) in rival.describe()) is yields


@given(st.lists(st.sampled_from([0, OWN, OTHER]), min_size=6, max_size=6))
def test_of_two_that_are_followed_exactly_one_yields(sessions: list[int]) -> None:
    one, two = RivalWatch(), RivalWatch()
    one.advance(OWN, following(*sessions), AGE_MAX_NS)
    two.advance(OTHER, following(*sessions), AGE_MAX_NS)
    assert not (one.yields and two.yields)
    if {OWN, OTHER} <= set(sessions):
        assert one.yields != two.yields


def test_beside_a_leader_it_is_refused(planner: Planner, q: Array) -> None:
    timing, told = timing_of(ROBOT), 0
    for tick in range(200):
        now_ns = START_NS + 4 * NS_PER_MS * tick
        commands, status = ticked(planner, q, now_ns, tick, session=OTHER)
        for command in commands:
            told += 1
            beside = msgspec.structs.replace(command, session=OTHER, echo_t_ns=now_ns)
            led, alone = Failsafe(session=OTHER, command=beside), Failsafe()
            assert led.offer(command, now_ns, timing) is Refusal.FOREIGN_SESSION
            assert alone.offer(command, now_ns, timing) is Refusal.TOO_OLD
    assert told == 4 * N_MODULES, "five times a second"
    assert (status.mode, status.hold) == (PlannerMode.YIELDING, True)
    assert f"another planner leads (session {OTHER})" in status.why


def test_ready_counts_only_for_ones_own_session(planner: Planner, q: Array) -> None:
    """A module that is ready for another planner's commands has none of this one."""
    for tick in range(20):
        now_ns = START_NS + TICK_NS * tick
        receive_but(planner, 2, q, now_ns, tick, session=OTHER, age_ns=60 * NS_PER_MS)
        planner.tick(now_ns)
    assert planner.status(now_ns, 0.0).mode == PlannerMode.ALIGNING


def test_refused_in_its_own_session_it_leads_in_a_new_one(planner: Planner, q: Array) -> None:
    """The modules retired its session for the other's while it was held up."""
    commands, _ = ticked(planner, q, START_NS, session=OTHER)
    assert all(command.echo_t_ns < START_NS - AGE_MAX_NS for command in commands)
    now_ns = START_NS + AGAIN_NS
    commands, _ = ticked(planner, q, now_ns, 2, session=OTHER, age_ns=AGAIN_NS + 1)
    assert {command.session for command in commands} == {SESSION}
    refused = {"refusal": int(Refusal.FOREIGN_SESSION), "refused_session": SESSION}
    now_ns += TICK_NS
    commands, _ = ticked(planner, q, now_ns, 3, session=OTHER, age_ns=2 * AGAIN_NS, **refused)
    assert {command.session for command in commands} == {SESSION + 1}
    for tick in range(4, 8):
        now_ns += TICK_NS
        _, status = ticked(planner, q, now_ns, tick, session=SESSION + 1, **refused)
    assert (status.mode, status.session) == (PlannerMode.LEADING, SESSION + 1)


def test_one_module_that_has_retired_its_session_is_regained(planner: Planner, q: Array) -> None:
    now_ns = lead(planner, q) + TICK_NS
    receive_but(planner, 1, q, now_ns, 8, session=OTHER)
    assert len(planner.tick(now_ns)) == N_MODULES, "it goes on beside a caught module"
    lost = {
        "session": OTHER, "age_ns": 60 * NS_PER_MS, "ready": False,
        "refusal": int(Refusal.FOREIGN_SESSION), "refused_session": SESSION,
    }  # fmt: skip
    for seq in (9, 10):  # once, and it goes on
        now_ns += TICK_NS
        receive_but(planner, 1, q, now_ns, seq, **lost)
        assert {command.session for command in planner.tick(now_ns)} == {SESSION + 1}


# ---- modules that may be limp: all stiffen for a knee, the knees for an ankle

FOR = {"ankle": Support.KNEES, "knee": Support.ALL, "hip": Support.NONE}
"""Who braces for a limp one of a kind."""
HOLDING = DriveStatus.HOLDING


def with_modes(*rows: tuple[str, Mode, DriveStatus], others: Mode = Mode.TRACK) -> list[JointState]:
    """Return six states; those of some modules have another mode and drive."""
    found = states(STILL, mode=int(others))
    for name, mode, drive in rows:
        index = MODULE_INDEX[name]
        found[index] = states(STILL, mode=int(mode), drive=int(drive))[index]
    return found


def braced(course: list[tuple[int, list[JointState]]]) -> list[Support]:
    """Return what is asked for, as states come at some ns."""
    watch = LimpLegWatch()
    return [watch.advance(START_NS + at_ns, rows) for at_ns, rows in course]


@each_module
@pytest.mark.parametrize("drive", list(DriveStatus))
def test_a_fault_is_braced_for_at_once_and_what_stays_disarmed_late(
    module: str, drive: DriveStatus
) -> None:
    """But a hip's. One that is silent may hold or have no power; one DISARMED may hold."""
    fault, out = (with_modes((module, mode, drive)) for mode in (Mode.FAULT, Mode.DISARMED))
    well, asked = with_modes((module, Mode.HOLD, DriveStatus.ARMED)), FOR[kind_of(module)]
    assert braced([(0, fault)]) == [asked]
    decided = braced([(at_ns, out) for at_ns in range(0, DISARMED_NS + 1, TICK_NS)])
    late = Support.NONE if drive is HOLDING else asked
    assert decided == [Support.NONE] * (DISARMED_NS // TICK_NS) + [late]
    again = [(0, out), (2 * DISARMED_NS, well), (3 * DISARMED_NS, out)]
    assert set(braced(again)) == {Support.NONE}, "the count starts again"


@each_module
def test_nobody_braces_for_a_restart_in_time(module: str) -> None:
    course = [
        (0, Mode.DISARMED, DriveStatus.LOST),
        (DISARMED_NS - TICK_NS, Mode.DISARMED, DriveStatus.LOST),
        (DISARMED_NS, Mode.DISARMED, HOLDING),
        (2 * DISARMED_NS, Mode.HOLD, DriveStatus.ARMED),
    ]
    rows = [(at_ns, with_modes((module, mode, drive))) for at_ns, mode, drive in course]
    assert set(braced(rows)) == {Support.NONE}


@pytest.mark.parametrize("ankle", ["ankle_left", "ankle_right"])
def test_a_knee_counts_before_an_ankle(ankle: str) -> None:
    """But one that restarts beside an ankle long out is given its own time.

    Otherwise the hips stiffen, and stay so: with one ankle 12 of 12 fell.
    """
    fault = (Mode.FAULT, DriveStatus.ERROR)
    assert braced([(0, with_modes((ankle, *fault), ("knee_left", *fault)))]) == [Support.ALL]
    lost = (Mode.DISARMED, DriveStatus.LOST)
    one, two = with_modes((ankle, *lost)), with_modes((ankle, *lost), ("knee_left", *lost))
    from_ns = 2 * DISARMED_NS + TICK_NS
    course = [(0, one), (from_ns - TICK_NS, one), (from_ns, two), (from_ns + DISARMED_NS, two)]
    assert braced(course) == [Support.NONE, Support.KNEES, Support.KNEES, Support.ALL]


@pytest.mark.parametrize("mode", [Mode.TRACK, Mode.HOLD, Mode.DAMP])
def test_modules_that_are_controlled_do_not_brace(mode: Mode) -> None:
    rows = with_modes(others=mode)
    assert set(braced([(tick * TICK_NS, rows) for tick in range(200)])) == {Support.NONE}


@each_module
def test_commands_to_brace_carry_the_hold(planner: Planner, q: Array, module: str) -> None:
    now_ns = lead(planner, q)
    assert not any(command.stiffen for command in planner.tick(now_ns))
    now_ns += TICK_NS
    gone = {"mode": int(Mode.FAULT), "drive": int(DriveStatus.ERROR)}
    receive_but(planner, MODULE_INDEX[module], q, now_ns, 9, **gone)
    decided = [(command.hold, command.stiffen) for command in planner.tick(now_ns)]
    asked = FOR[kind_of(module)]
    assert decided == [(True, asked.includes(name)) for name in MODULES]


# ---- the harness's wrench is believed as long as the load beneath it stays what it was

LASTS = round(AFTER_S / DT) + 2


def go_on(
    trust: HarnessTrust, load: LoadState, ticks: int = LASTS, tare: Tare = Tare.DONE,
    *, leads: bool = True,
) -> float:  # fmt: skip
    for _ in range(ticks):
        scale = trust.advance(load, tare, DT, leads=leads)
    return scale


def trusted(load: LoadState) -> HarnessTrust:
    """Return the watch of a planner that has led with a load."""
    trust = HarnessTrust()
    go_on(trust, load, 1, leads=False)
    assert go_on(trust, load, 1) == 1.0
    return trust


@pytest.mark.parametrize("leads", [True, False])
@pytest.mark.parametrize("part", range(3))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_load_that_changes_once_it_was_led_is_the_sensors_fault_and_not_learnt(
    part: int, sign: float, leads: bool
) -> None:
    before = (1.0, -2.0, 0.5)
    change = sign * np.array((CHANGE_MAX[0], CHANGE_MAX[1], CHANGE_MAX[1])) * np.eye(3)[part]
    trust = trusted(LoadState(*before))
    just, wrong = (LoadState(*(before + share * change).tolist()) for share in (0.99, 1.01))
    go_on(trust, just, leads=leads)
    assert not trust.doubted
    wrong.refused, wrong.weighing_s = True, 1.0
    go_on(trust, wrong, leads=leads)
    assert trust.doubted
    assert wrong == LoadState(*before)
    assert "xrl drive tare" in trust.describe()


def test_a_change_that_does_not_last_is_a_robot_that_swings() -> None:
    trust = trusted(LoadState(0.0))
    for _ in range(10):
        go_on(trust, LoadState(9.0), LASTS - 4)
        go_on(trust, LoadState(0.0), 1)
    assert not trust.doubted


def test_a_load_that_changes_before_it_is_led_is_a_load() -> None:
    trust = HarnessTrust()
    for kg in (0.0, 7.0):
        go_on(trust, LoadState(kg), leads=False)
    go_on(trust, LoadState(7.0))
    assert (trust.doubted, trust.describe()) == (False, "")


def test_the_assist_fades_while_the_wrench_is_doubted_and_comes_back_with_a_new_zero() -> None:
    trust, ticks, load = trusted(LoadState(0.0)), round(TRUST_EASE_S / DT), LoadState(0.0)
    go_on(trust, LoadState(5.0))
    assert go_on(trust, load, ticks // 2) == pytest.approx(0.5, abs=0.01)
    assert go_on(trust, load, ticks) == 0.0
    assert go_on(trust, load, leads=False) == 0.0, "HOLD is no new zero"
    go_on(trust, load, 1, Tare.RUNNING, leads=False)
    assert not trust.doubted
    assert go_on(trust, load, ticks) == 1.0


# ---- before a motor is too warm

NONE, EASES, STANDS_UP, RESTS = HeatAction
SQUATTED, STRAIGHT = -1.2, -0.3
HEAT = ROBOT.heat


class Heated:
    """A watch over six modules, in ticks of 0.1 s."""

    def __init__(self) -> None:
        self.watch, self.state, self.now_s = HeatWatch(HEAT), HeatWatchState(), 100.0

    def run(
        self, left_s: float, knee: float = SQUATTED, *, seconds: float = 0.1,
        requested: float = 0.0, lifted: float | None = 0.0, module: int = 1,
    ) -> HeatDecision:  # fmt: skip
        rows = states(np.tile((0.0, knee), N_MODULES), heat_left_s=3600.0)
        rows[module] = msgspec.structs.replace(rows[module], heat_left_s=left_s)
        for _ in range(max(1, round(10.0 * seconds))):
            now_ns = round(self.now_s * NS_PER_S)
            self.state.lifted = lifted
            decision = self.watch.advance(self.state, now_ns, rows, requested, 0.1)
            self.now_s += 0.1
        return decision

    @property
    def said(self) -> str:
        return self.watch.describe(self.state)


@pytest.mark.parametrize("module", range(N_MODULES))
def test_each_module_is_watched_and_named(module: int) -> None:
    heated = Heated()
    heated.run(HEAT.stand_s - 1.0, module=module)
    assert heated.state.action is STANDS_UP
    assert heated.said.startswith(MODULES[module])


def test_every_action_follows_at_its_limit_and_no_sooner() -> None:
    heated = Heated()
    for left_s, knee, action in (
        (-1.0, SQUATTED, NONE),  # not estimated
        (3600.0, SQUATTED, NONE),
        (HEAT.ease_s, SQUATTED, NONE),
        (HEAT.ease_s - 0.1, SQUATTED, EASES),
        (10.0 * HEAT.ease_s - 0.1, SQUATTED, EASES),
        (10.0 * HEAT.ease_s, SQUATTED, NONE),
        (HEAT.stand_s, SQUATTED, EASES),
        (HEAT.stand_s - 0.1, SQUATTED, STANDS_UP),
        (3600.0, SQUATTED, STANDS_UP),  # nothing ends it half way
        (3600.0, STRAIGHT, RESTS),
        (3600.0, STRAIGHT - 0.2, RESTS),
        (3600.0, SQUATTED, STANDS_UP),  # pressed down again
    ):
        heated.run(left_s, knee)
        assert heated.state.action is action, (left_s, knee)


def test_it_rests_for_a_while_and_until_enough_is_left() -> None:
    heated = Heated()
    heated.run(1.0)
    heated.run(3600.0, STRAIGHT, seconds=REST_S - 1.0)
    assert heated.state.action is RESTS
    assert heated.run(1.5 * HEAT.ease_s, STRAIGHT, seconds=2.0).toward is Toward.REST
    for lifted in (-HAND_MAX - 1.0, HAND_MAX + 1.0, None):
        assert heated.run(3600.0, STRAIGHT, seconds=1.0, lifted=lifted).toward is Toward.REST
    assert heated.run(3600.0, STRAIGHT, seconds=1.0).toward is Toward.PERSON
    assert heated.state.action is NONE


def test_straight_and_still_too_hot_it_says_what_a_person_must_do() -> None:
    heated = Heated()
    heated.run(1.0)
    heated.run(3600.0, STRAIGHT, module=4)
    assert heated.said.startswith(f"{MODULES[1]} was hot")
    heated.run(HEAT.ease_s - 1.0, STRAIGHT, module=4)
    assert "left even on straight legs" in heated.said
    assert heated.said.startswith(MODULES[4])


def test_the_assist_goes_but_never_from_under_the_person() -> None:
    free, resting, left_s = Heated(), Heated(), HEAT.ease_s - 5.0
    assert free.run(left_s, requested=200.0).assist == pytest.approx(200.0 - 20.0 * 0.1)
    free.run(left_s, requested=200.0, seconds=EASE_S)
    assert free.run(left_s, requested=200.0).assist == pytest.approx(0.0)
    resting.run(left_s, requested=200.0, lifted=-150.0, seconds=EASE_S)
    decision = resting.run(left_s, requested=200.0, lifted=-150.0)
    assert decision.assist == pytest.approx(150.0 - RESTED_ON)
    assert resting.run(left_s, requested=100.0, lifted=-150.0).assist <= 100.0
    decision = resting.run(left_s, requested=200.0, lifted=0.0, seconds=10.0)
    assert decision.assist == pytest.approx(150.0 - RESTED_ON - 10.0 * SHED_RATE)


# ---- a battery that runs low

LEVELS = SupplyConfig(low_v=44.0, sit_v=42.0)


def supplied(*course: tuple[float, float], levels: SupplyConfig = LEVELS) -> Kept:
    """Return a watch that saw volts of one module for some seconds, 48 V at first."""
    watch = Kept(SupplyWatch(levels), SupplyState())
    for volts, seconds in ((48.0, DT), *course):
        rows = all_states(supply_v=48.0)
        rows["knee_left"] = all_states(supply_v=volts)["knee_left"]
        for _ in range(round(seconds / DT)):
            watch.advance(list(rows.values()), DT)
    return watch


@pytest.mark.parametrize(
    ("course", "low", "sits"),
    [
        ([(44.01, 20 * POLE_S)], False, False),
        ([(43.99, 20 * POLE_S)], True, False),
        ([(42.01, 20 * POLE_S)], True, False),
        ([(41.99, 20 * POLE_S)], True, True),
        ([(46.0, 1.0), (38.0, 0.3)], False, False),  # a step of the load is no empty battery
        # a level lasts until the supply has recovered
        ([(41.0, 10 * POLE_S), (42.0 + 0.9 * RECOVERED_V, 20 * POLE_S)], True, True),
        ([(41.0, 10 * POLE_S), (42.0 + 1.1 * RECOVERED_V, 20 * POLE_S)], True, False),
        ([(41.0, 10 * POLE_S), (48.0, 20 * POLE_S)], False, False),
        ([(0.0, 5.0)], False, False),  # a drive that tells nothing is none with an empty battery
    ],
)
def test_the_lowest_supply_counts_and_is_named(
    course: list[tuple[float, float]], low: bool, sits: bool
) -> None:
    watch = supplied(*course)
    assert (watch.state.low, watch.state.sits) == (low, sits)
    words = watch.describe()
    assert ("the supply of knee_left is at 4" in words) is low
    assert ("now" in words) is sits
    assert bool(words) is low


def test_without_volts_or_levels_nothing_is_told_nor_moved_by_another_battery() -> None:
    silent = Kept(SupplyWatch(LEVELS), SupplyState())
    silent.advance(list(all_states().values()), DT)
    assert (silent.state.volts, silent.describe()) == (0.0, "")
    assert supplied((0.0, 5.0)).state.volts == pytest.approx(48.0)
    assert supplied((20.0, 5.0), levels=SupplyConfig(low_v=0.0, sit_v=0.0)).describe() == ""
    other = Kept(SupplyWatch(LEVELS), SupplyState())  # than the file says
    for _ in range(2000):
        other.advance(list(all_states(supply_v=24.0).values()), DT)
    assert (other.state.low, other.state.sits) == (True, False)
