"""What the planner watches in states: another planner, and modules that may be limp."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.failsafe import Failsafe, timing_of
from services.planner.planner import Planner
from services.planner.watch.limp_leg_watch import DISARMED_NS, LimpLegWatch
from services.planner.watch.rival_watch import AGAIN_NS, RivalWatch
from shared.arrays import Array
from shared.bus.messages import DriveStatus, JointState, Mode, PlannerMode, Refusal
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.joints import MODULE_INDEX, MODULES, N_MODULES, kind_of
from shared.robot.hold_rules import Support
from tests.planner.conftest import Closed
from tests.planner.states import SESSION, START_NS, TICK_NS, lead, receive_all, receive_but, state

OWN, OTHER = 7, 9


AGE_MAX_NS = 50 * NS_PER_MS


def following(*sessions: int, age_ns: int = 2 * NS_PER_MS) -> list[JointState]:
    return cast(
        "list[JointState]",
        [
            SimpleNamespace(session=session, age_ns=age_ns, refusal=0, refused_session=0)
            for session in sessions
        ],
    )


def watch(*sessions: int, own: int = OWN, age_ns: int = 2 * NS_PER_MS) -> RivalWatch:
    rival = RivalWatch()
    rival.advance(own, following(*sessions, age_ns=age_ns), AGE_MAX_NS)
    return rival


LATE_NS = AGE_MAX_NS + 1


@pytest.mark.parametrize(
    ("states", "own", "yields"),
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
    states: list[JointState], own: int, yields: bool
) -> None:
    rival = RivalWatch()
    rival.advance(own, states, AGE_MAX_NS)
    assert rival.yields is yields
    assert (str(OTHER) in rival.describe()) is yields


@given(st.lists(st.sampled_from([0, OWN, OTHER]), min_size=6, max_size=6))
def test_of_two_that_are_followed_exactly_one_yields(sessions: list[int]) -> None:
    one, two = watch(*sessions, own=OWN).yields, watch(*sessions, own=OTHER).yields
    assert not (one and two)
    if {OWN, OTHER} <= set(sessions):
        assert one != two


@pytest.fixture
def level_q(closed: Closed) -> Array:
    return closed(1.188)


def test_beside_a_leader_it_is_refused(
    planner: Planner, level_q: Array, robot: RobotConfig
) -> None:
    timing = timing_of(robot)
    told = 0
    for tick in range(200):
        now_ns = START_NS + 4 * NS_PER_MS * tick
        receive_all(planner, level_q, now_ns, seq=tick, session=OTHER)
        for command in planner.tick(now_ns):
            told += 1
            beside = msgspec.structs.replace(command, session=OTHER, echo_t_ns=now_ns)
            led, alone = Failsafe(session=OTHER, command=beside), Failsafe()
            assert led.offer(command, now_ns, timing) is Refusal.FOREIGN_SESSION
            assert alone.offer(command, now_ns, timing) is Refusal.TOO_OLD
    assert told == 4 * N_MODULES, "five times a second"
    status = planner.status(now_ns, 0.0)
    assert (status.mode, status.hold) == (PlannerMode.YIELDING, True)
    assert f"another planner leads (session {OTHER})" in status.why


def test_ready_counts_only_for_ones_own_session(planner: Planner, level_q: Array) -> None:
    """A module that is ready for another planner's commands has none of this one."""
    for tick in range(20):
        now_ns = START_NS + TICK_NS * tick
        receive_but(planner, 2, level_q, now_ns, tick, session=OTHER, age_ns=60 * NS_PER_MS)
        planner.tick(now_ns)
    assert planner.status(now_ns, 0.0).mode == PlannerMode.ALIGNING


def test_refused_in_its_own_session_it_leads_in_a_new_one(planner: Planner, level_q: Array) -> None:
    """The modules retired its session for the other's while it was held up."""
    receive_all(planner, level_q, START_NS, session=OTHER)
    assert all(command.echo_t_ns < START_NS - AGE_MAX_NS for command in planner.tick(START_NS))
    now_ns = START_NS + AGAIN_NS
    receive_all(planner, level_q, now_ns, seq=2, session=OTHER, age_ns=AGAIN_NS + 1)
    assert {command.session for command in planner.tick(now_ns)} == {SESSION}
    refused = {"refusal": int(Refusal.FOREIGN_SESSION), "refused_session": SESSION}
    now_ns += 4 * NS_PER_MS
    receive_all(planner, level_q, now_ns, seq=3, session=OTHER, age_ns=2 * AGAIN_NS, **refused)
    assert {command.session for command in planner.tick(now_ns)} == {SESSION + 1}
    for tick in range(4, 8):
        now_ns += 4 * NS_PER_MS
        receive_all(planner, level_q, now_ns, seq=tick, session=SESSION + 1, **refused)
        planner.tick(now_ns)
    status = planner.status(now_ns, 0.0)
    assert (status.mode, status.session) == (PlannerMode.LEADING, SESSION + 1)


def test_one_module_that_has_retired_its_session_is_regained(
    planner: Planner, level_q: Array
) -> None:
    now_ns = lead(planner, level_q)
    lost = {
        "session": OTHER, "age_ns": 60 * NS_PER_MS, "ready": False,
        "refusal": int(Refusal.FOREIGN_SESSION), "refused_session": SESSION,
    }  # fmt: skip
    for seq in (9, 10):  # once, and it goes on
        now_ns += TICK_NS
        receive_but(planner, 1, level_q, now_ns, seq, **lost)
        assert {command.session for command in planner.tick(now_ns)} == {SESSION + 1}


def test_one_that_leads_goes_on_beside_a_caught_module(planner: Planner, level_q: Array) -> None:
    now_ns = lead(planner, level_q) + TICK_NS
    receive_but(planner, 1, level_q, now_ns, 9, session=OTHER)
    assert len(planner.tick(now_ns)) == N_MODULES


# ---- modules that may be limp: all stiffen for a knee, the knees for an ankle

FOR = {"ankle": Support.KNEES, "knee": Support.ALL, "hip": Support.NONE}
"""Who braces for a limp one of a kind."""


KNEES = [name for name in MODULES if kind_of(name) == "knee"]


def states(
    q: Array, module: str, mode: Mode, drive: DriveStatus = DriveStatus.ARMED
) -> list[JointState]:
    rows = [state(index, q) for index in range(N_MODULES)]
    index = MODULE_INDEX[module]
    rows[index] = state(index, q, mode=int(mode), drive=int(drive))
    return rows


def braced_in(rows: list[JointState], ticks: int) -> set[Support]:
    """Return what is asked for in so many ticks of the same states."""
    watch = LimpLegWatch()
    return {watch.advance(START_NS + tick * TICK_NS, rows) for tick in range(ticks)}


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.parametrize("drive", list(DriveStatus))
def test_a_fault_is_braced_for_at_once(q: Array, module: str, drive: DriveStatus) -> None:
    """But a hip's. One that is silent may hold or have no power."""
    decided = LimpLegWatch().advance(START_NS, states(q, module, Mode.FAULT, drive))
    assert decided is FOR[kind_of(module)]


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.parametrize("drive", [d for d in DriveStatus if d is not DriveStatus.HOLDING])
def test_what_stays_disarmed_is_braced_for_late(q: Array, module: str, drive: DriveStatus) -> None:
    limp_legs, rows = LimpLegWatch(), states(q, module, Mode.DISARMED, drive)
    decided = [
        limp_legs.advance(START_NS + off, rows) for off in range(0, DISARMED_NS + 1, TICK_NS)
    ]
    assert decided == [Support.NONE] * (DISARMED_NS // TICK_NS) + [FOR[kind_of(module)]]
    well = states(q, module, Mode.HOLD, DriveStatus.ARMED)
    assert not limp_legs.advance(START_NS + 2 * DISARMED_NS, well)
    assert not limp_legs.advance(START_NS + 3 * DISARMED_NS, rows), "the count starts again"


@pytest.mark.parametrize("module", MODULES)
def test_nobody_braces_for_a_drive_that_holds(q: Array, module: str) -> None:
    rows = states(q, module, Mode.DISARMED, DriveStatus.HOLDING)
    assert braced_in(rows, 1000) == {Support.NONE}


@pytest.mark.parametrize("module", MODULES)
def test_nobody_braces_for_a_restart_in_time(q: Array, module: str) -> None:
    limp_legs = LimpLegWatch()
    course = [
        (0, Mode.DISARMED, DriveStatus.LOST),
        (DISARMED_NS - TICK_NS, Mode.DISARMED, DriveStatus.LOST),
        (DISARMED_NS, Mode.DISARMED, DriveStatus.HOLDING),
        (2 * DISARMED_NS, Mode.HOLD, DriveStatus.ARMED),
    ]
    for off_ns, mode, drive in course:
        assert not limp_legs.advance(START_NS + off_ns, states(q, module, mode, drive))


@pytest.mark.parametrize("ankle", ["ankle_left", "ankle_right"])
def test_a_knee_counts_before_an_ankle(q: Array, ankle: str) -> None:
    rows = states(q, ankle, Mode.FAULT, DriveStatus.ERROR)
    index = MODULE_INDEX["knee_left"]
    rows[index] = state(index, q, mode=int(Mode.FAULT))
    assert LimpLegWatch().advance(START_NS, rows) is Support.ALL


def test_a_knee_that_restarts_beside_an_ankle_long_out_is_given_its_own_time(q: Array) -> None:
    """Otherwise the hips stiffen, and stay so: with one ankle 12 of 12 fell."""
    limp_legs, out = LimpLegWatch(), states(q, "ankle_left", Mode.DISARMED, DriveStatus.LOST)
    limp_legs.advance(START_NS, out)
    assert limp_legs.advance(START_NS + 2 * DISARMED_NS, out) is Support.KNEES
    index = MODULE_INDEX["knee_left"]
    out[index] = state(index, q, mode=int(Mode.DISARMED), drive=int(DriveStatus.LOST))
    for off_ns, asked in ((0, Support.KNEES), (DISARMED_NS, Support.ALL)):
        assert limp_legs.advance(START_NS + 2 * DISARMED_NS + TICK_NS + off_ns, out) is asked


@pytest.mark.parametrize("mode", [Mode.TRACK, Mode.HOLD, Mode.DAMP])
def test_modules_that_are_controlled_do_not_brace(q: Array, mode: Mode) -> None:
    rows = [state(index, q, mode=int(mode)) for index in range(N_MODULES)]
    assert braced_in(rows, 200) == {Support.NONE}


@pytest.mark.parametrize("module", MODULES)
def test_commands_to_brace_carry_the_hold(planner: Planner, q: Array, module: str) -> None:
    now_ns = lead(planner, q)
    assert not any(command.stiffen for command in planner.tick(now_ns))
    now_ns += TICK_NS
    gone = {"mode": int(Mode.FAULT), "drive": int(DriveStatus.ERROR)}
    receive_but(planner, MODULE_INDEX[module], q, now_ns, 9, **gone)
    decided = [(command.hold, command.stiffen) for command in planner.tick(now_ns)]
    asked = FOR[kind_of(module)]
    assert decided == [(True, asked.includes(name)) for name in MODULES]


def test_knees_are_knees() -> None:
    assert [name for name in MODULES if Support.KNEES.includes(name)] == KNEES
    assert [name for name in MODULES if Support.ALL.includes(name)] == list(MODULES)
    assert not any(Support.NONE.includes(name) for name in MODULES)
