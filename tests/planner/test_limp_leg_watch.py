"""Which modules the planner asks to stiffen: all for a limp knee, the knees for a limp ankle."""

from __future__ import annotations

import pytest

from services.planner.planner import Planner
from services.planner.watch.limp_leg_watch import DISARMED_NS, LimpLegWatch
from shared.bus.messages import DriveStatus, JointState, Mode
from shared.joints import MODULE_INDEX, MODULES, N_MODULES, kind_of
from shared.robot.limp_leg_support import Support
from tests.planner.oracle import Array
from tests.planner.states import START_NS, TICK_NS, lead, receive_but, state

FOR = {"ankle": Support.KNEES, "knee": Support.ALL, "hip": Support.NONE}
"""Who braces for a limp one of a kind."""


BRACED_FOR = [name for name in MODULES if FOR[kind_of(name)]]


HIPS = [name for name in MODULES if kind_of(name) == "hip"]


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
    """One that is silent may hold or have no power."""
    decided = LimpLegWatch().advance(START_NS, states(q, module, Mode.FAULT, drive))
    assert decided is FOR[kind_of(module)]


@pytest.mark.parametrize("module", BRACED_FOR)
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


@pytest.mark.parametrize("module", BRACED_FOR)
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


@pytest.mark.parametrize("module", HIPS)
@pytest.mark.parametrize("mode", [Mode.FAULT, Mode.DISARMED])
def test_no_leg_is_stiffened_for_a_hip(q: Array, module: str, mode: Mode) -> None:
    for drive in DriveStatus:
        assert braced_in(states(q, module, mode, drive), 300) == {Support.NONE}


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
