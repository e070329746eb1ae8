"""A drive's fault in virtual time: every row of the fault table, and five that hold the robot."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import pytest

from shared.bus.messages import Cause, DriveStatus, Mode
from shared.bus.traces import SimTruth
from shared.can.cansimple import AxisState
from shared.config.scenarios import FAULT_KINDS, Fault, FaultKind, Keyframe
from shared.joints import MODULE_INDEX, MODULES
from shared.robot.fault_table import DRIVE_FAULTS, DriveFault
from tests.lockstep.runs import Run, kill, modes_of, push, restart, run, still, variant
from tests.robots import ROBOT
from tools.lab.studies.sweeps import plants
from tools.sim.lockstep import Lockstep

CLOSED = AxisState.CLOSED_LOOP_CONTROL
MODULE = "hip_left"
INDEX = MODULE_INDEX[MODULE]
AXES = slice(2 * INDEX, 2 * INDEX + 2)
assert set(DRIVE_FAULTS) == set(FAULT_KINDS), "every kind of fault has a row"
AT, OVER, RESTARTED = 0.5, 1.1, 2.0
"""s; a fault that lasts is over by `OVER`."""
LATE, AT_REST = 1.09, 1.99
"""s; while a fault still lasts, and long after it."""

BLIND_S = 0.052
"""s for which a drive stays armed without words from its encoder."""
OLD_NS = 50_000_000
"""No frame that is older reaches a drive."""
NOTHING: Final = {"kill": (), "restart": (), "push": ()}


def fault(kind: FaultKind, module: str, at: float, lasts: float | None = None) -> tuple[Fault]:
    return (Fault(module=module, kind=kind, at=at, duration=lasts),)


def into_fault(outcome: Run) -> list[tuple[str, int, float]]:
    """Return module, cause and scenario time of every change to FAULT."""
    start_ns = outcome.rows[0].t_ns - round(outcome.rows[0].scenario_s * 1e9)
    return [
        (module, event.cause, (event.t_ns - start_ns) / 1e9)
        for module, event in outcome.lockstep.events
        if event.mode_after == Mode.FAULT
    ]


class Faulted(NamedTuple):
    """A run with one fault, whose module is restarted at last."""

    kind: FaultKind
    row: DriveFault
    run: Run
    modes: dict[float, list[Mode]]
    """By scenario time, s."""
    armed: dict[float, np.ndarray]
    """Which of the twelve axes are in closed loop."""


@pytest.fixture(scope="module", params=[kind for kind, row in DRIVE_FAULTS.items() if row.cause])
def faulted(request: pytest.FixtureRequest) -> Faulted:
    kind: FaultKind = request.param
    modes, armed = {}, {}

    def look(fleet: Lockstep, row: SimTruth) -> None:
        at = round(row.scenario_s, 2)
        modes[at], armed[at] = modes_of(fleet), np.array(fleet.bank.state) == CLOSED

    lasts = None if FAULT_KINDS[kind].duration is None else OVER - AT
    lasts = None if kind == "encoder_gap" else lasts  # any longer and it is an error
    restarts = {"kill": kill(RESTARTED, MODULE), "restart": restart(RESTARTED + 0.02, MODULE)}
    scenario = still(3.3, fault=fault(kind, MODULE, AT, lasts), **restarts)
    return Faulted(kind, DRIVE_FAULTS[kind], run(ROBOT, scenario, each=look), modes, armed)


def test_a_module_goes_to_fault_for_its_rows_cause_and_five_hold(faulted: Faulted) -> None:
    """And stays in it, though the fault is over, without a request."""
    ((module, cause, at),) = into_fault(faulted.run)
    assert (module, cause) == (MODULE, faulted.row.cause)
    later_s = {"encoder": BLIND_S, "over_temperature": 0.5}.get(faulted.kind, 0.0)
    assert AT <= at <= AT + later_s + (0.15 if cause == Cause.DRIVE_LOST else 0.005)
    for modes in (faulted.modes[LATE], faulted.modes[AT_REST]):
        assert modes.count(Mode.HOLD) == 5
    assert faulted.modes[AT_REST][INDEX] is Mode.FAULT
    assert faulted.run.stood, "on one hip"


def test_both_axes_of_a_module_are_limp_or_neither_is_by_its_row(faulted: Faulted) -> None:
    """While the fault lasts, and after: a drive whose cable is out holds by its own loop."""
    for armed in (faulted.armed[LATE], faulted.armed[AT_REST]):
        assert list(armed[AXES]) == [not faulted.row.limp] * 2
        assert np.delete(armed, [AXES.start, AXES.start + 1]).all()


def test_a_restart_arms_again_unless_the_zero_is_lost(faulted: Faulted) -> None:
    fleet = faulted.run.lockstep
    if faulted.row.zero_lost:
        assert faulted.run.modes[INDEX] is Mode.DISARMED
        assert fleet.controllers[INDEX].estimate.status is DriveStatus.UNZEROED
        assert not fleet.bank.torque[AXES].any()
    else:
        assert faulted.run.modes == [Mode.TRACK] * 6


def test_what_a_lost_encoder_reports_is_never_taken_for_the_joint() -> None:
    knee = MODULE_INDEX["knee_left"]
    scenario = still(AT + BLIND_S + 0.02, fault=fault("encoder", "knee_left", AT))
    thetas = []
    outcome = run(
        ROBOT, scenario, each=lambda fleet, _: thetas.append(fleet.controllers[knee].estimate.q[1])
    )
    assert thetas[-1] == pytest.approx(thetas[-4], abs=0.02), "as before the fault"
    held = outcome.steps_nm("knee_left", after=Mode.HOLD)
    assert max(held, default=0.0) < 3.0, "1.5 N m measured: what 50 ms of a limp knee add up to"


def test_a_cable_out_for_less_than_it_takes_to_be_lost_changes_nothing() -> None:
    outcome = run(ROBOT, still(1.0, fault=fault("link_lost", MODULE, AT, 0.04)))
    assert into_fault(outcome) == []
    assert outcome.stood


@pytest.mark.parametrize("kind", [kind for kind, row in DRIVE_FAULTS.items() if not row.cause])
def test_a_fault_without_a_cause_leaves_every_module_in_control(kind: FaultKind) -> None:
    module = MODULE if kind == "encoder_gap" else "knee_left"  # a knee in the squat: OVERSPEED
    scenario = variant("squat", duration=2.0, fault=fault(kind, module, 1.0), **NOTHING)
    outcome = run(ROBOT, scenario)
    assert outcome.stood
    assert into_fault(outcome) == []
    assert max(outcome.lockstep.buses["knee_left"].ages_ns, default=0) < OLD_NS
    assert set(outcome.lockstep.bank.state) == {CLOSED}


# ---- nobody acknowledges: what waits in the kernel, and what of it reaches a drive


def cut(modules: Sequence[str], at: float, lasts: float) -> tuple[Fault, ...]:
    """Return a power cut of the CAN side of some drives, which hold by their own loops."""
    return tuple(each for name in modules for each in fault("link_lost", name, at, lasts))


@pytest.mark.parametrize("lasts", [0.03, 1.5])
def test_a_power_cut_of_all_buses_in_a_squat_brings_no_old_frame(lasts: float) -> None:
    told_s = set()

    def look(fleet: Lockstep, row: SimTruth) -> None:
        statuses = {each.estimate.status for each in fleet.controllers}
        if statuses == {DriveStatus.UNACKNOWLEDGED}:
            told_s.add(row.scenario_s - 1.5)

    scenario = variant("squat", duration=2.0 + lasts, fault=cut(MODULES, 1.5, lasts), **NOTHING)
    outcome = run(ROBOT, scenario, each=look)
    assert outcome.stood
    for bus in outcome.lockstep.buses.values():
        assert max(bus.ages_ns, default=0) < OLD_NS
        assert bus.thrown_away > 0 or lasts < 0.05
    assert min(told_s, default=0.0) < 0.2
    assert bool(told_s) is (lasts > 0.1)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("after_ms", [-10, -2, 0, 4])
def test_a_power_cut_while_arming_leaves_no_request_behind(after_ms: int) -> None:
    """A limp module's service is restarted, and arms it; the cut comes about then."""
    cut_s, waits = 1.024 + 1e-3 * after_ms, []

    def look(fleet: Lockstep, row: SimTruth) -> None:
        if row.scenario_s > cut_s + 0.05:
            waits.append(fleet.buses[MODULE].waiting)

    restarts = {"kill": kill(1.0, MODULE), "restart": restart(1.02, MODULE)}
    dead = cut((MODULE,), cut_s, 0.5)
    scenario = still(2.4, fault=(*fault("disarmed", MODULE, AT), *dead), **restarts)
    outcome = run(ROBOT, scenario, each=look)
    assert max(outcome.lockstep.buses[MODULE].ages_ns, default=0) < OLD_NS
    assert not any(waits), "nothing is left to be delivered"
    assert waits
    assert set(outcome.lockstep.bank.state[AXES]) == {CLOSED}, "armed anew, or all along"


# ---- one module limp: the others stiffen and keep the robot up


def stiffened(outcome: Run) -> list[str]:
    """Return the modules that hold with all they have."""
    fleet = outcome.lockstep
    states = [
        joint.manager.controller.state(joint.manager.state.controller, fleet.now_ns)
        for joint in fleet.joints
    ]
    return [name for name, state in zip(MODULES, states, strict=True) if state.stiffened]


LASTING = 2.6
"""s from the fault on, with a push after 1 s; unless the others stiffened, a limp knee fell after
1.2 to 1.3 s."""


@pytest.mark.parametrize(
    ("name", "module", "kind", "at", "force", "led"),
    [
        ("squat", "knee_right", "encoder", 1.5, (0.0, 30.0, 0.0), True),
        ("squat", "knee_left", "disarmed", 0.3, (30.0, 0.0, 0.0), True),
        # 15 N is near its limit: a push of 20 N to the side ends in a fall
        ("crawl", "knee_right", "disarmed", 0.9, (0.0, 15.0, 0.0), True),
        ("squat", "knee_left", "over_voltage", 2.3, (-30.0, 0.0, 0.0), True),
        # services see it in each other's rows; when only a planner told them 9 of 9 fell
        ("squat", "knee_left", "disarmed", 0.3, (0.0, 30.0, 0.0), False),
        ("squat", "knee_left", "disarmed", 1.5, (30.0, 0.0, 0.0), False),
        ("squat", "knee_left", "disarmed", 2.4, (0.0, -30.0, 0.0), False),
    ],
)
def test_a_limp_knee_stands_on_five_that_brace_and_takes_a_push(
    name: str, module: str, kind: FaultKind, at: float,
    force: tuple[float, float, float], led: bool,
) -> None:  # fmt: skip
    """The leg stands as a strut: on the hips' soft gains it folded at every phase of the squat."""
    happens = {"fault": fault(kind, module, at), "kill": () if led else kill(at - 0.2)}
    pushed = (push(at + 1.0, *force),)
    outcome = run(ROBOT, variant(name, duration=at + LASTING, restart=(), push=pushed, **happens))
    assert outcome.stood
    assert abs(outcome.com_mm[outcome.t > at, :2]).max() < (60.0 if led else 75.0)
    assert outcome.modes[MODULE_INDEX[module]] is Mode.FAULT
    assert stiffened(outcome) == [other for other in MODULES if other != module]
    assert not led or max(outcome.steps_nm(module, after=Mode.HOLD)) < 3.0, "none of the five jerks"


@pytest.mark.sampled(2)
@pytest.mark.parametrize("at", [1.0, 0.5, 1.7, 2.4])
def test_a_knee_that_falls_silent_without_power_stands(at: float) -> None:
    """Braced for once it was lost, after 100 ms, 3 of 4 fell."""
    silent = fault("brown_out", "knee_left", at)
    outcome = run(ROBOT, variant("squat", duration=at + LASTING, fault=silent, push=(), kill=()))
    assert outcome.stood
    assert stiffened(outcome) == [other for other in MODULES if other != "knee_left"]


def test_for_a_limp_ankle_the_knees_alone_brace() -> None:
    """Stiff hips handed the hand's moment to the one ankle that is left: 4 of 4 fell."""
    limp = fault("disarmed", "ankle_left", 0.886)
    outcome = run(ROBOT, variant("crawl", duration=0.886 + LASTING, fault=limp, push=()))
    assert outcome.stood
    assert stiffened(outcome) == ["knee_right", "knee_left"]
    assert abs(outcome.com_mm[:, 0]).max() < 120.0, "within the sole that is left"


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("x", "led"), [(30.0, True), (-30.0, True), (-30.0, False), (30.0, False)])
def test_pushed_beside_a_limp_ankle_it_stands(x: float, led: bool) -> None:
    """One sole is left: it bears 47 N under any control, 23 with HOLD's gains."""
    limp = fault("disarmed", "ankle_left", 0.7)
    told = still(4.5, fault=limp, push=(push(1.7, x, 0.0, 0.0),), kill=() if led else kill(0.5))
    assert run(ROBOT, told).stood


@pytest.mark.parametrize(("height", "pitch"), [(1.1, 0.5), (0.95, 0.9)])
def test_a_turned_torso_stays_turned(height: float, pitch: float) -> None:
    """Six such robots without a planner: pulled upright against the hand, two fell."""
    happens = {"kill": kill(0.5), "fault": fault("disarmed", "knee_left", 2.5)}
    turned = (Keyframe(at=0.0, height=height), Keyframe(at=2.0, height=height, pitch=pitch))
    outcome = run(ROBOT, variant("stand", duration=5.0, keyframe=turned, **happens))
    assert outcome.stood
    before, after = outcome.angles[outcome.t < 2.5][-1, 1], outcome.angles[-1, 1]
    assert abs(before) > 0.3
    assert after == pytest.approx(before, abs=0.15)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("number", range(8, 16))
def test_on_drawn_plants_a_limp_knee_stands(number: int) -> None:
    """Half of them with the planner dead, half let go. On the hips' stand gains 3 of 8 fell."""
    draw = random.Random(f"limp knee {number}")
    at, angle = draw.uniform(0.3, 3.0), draw.uniform(0.0, math.tau)
    pushed = push(at + 1.5, 30.0 * math.cos(angle), 30.0 * math.sin(angle), 0.0)
    limp = fault("disarmed", draw.choice(("knee_left", "knee_right")), at)
    dead = kill(at - 0.1) if number % 2 else ()
    scenario = variant(
        "squat", duration=at + 3.3, kill=dead, restart=(), fault=limp, push=(pushed,)
    )

    def let_go(fleet: Lockstep, row: SimTruth) -> None:
        if number // 2 % 2 and row.scenario_s >= at + 0.2:
            fleet.world.let_go()

    plant = plants.draw(f"limp knee {number}")
    assert run(ROBOT, scenario, plant=plant, stands=False, each=let_go).stood
