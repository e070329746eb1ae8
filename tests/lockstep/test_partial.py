"""Partial failures in a squat: any subset of the modules cut off or frozen, the others well.

Each of the four kinds has 63 subsets, at 1.2 s of CPU each: all 252 take five minutes of one core,

    XRL_ALL_SUBSETS=1 ./deploy/test tests/lockstep/test_partial.py

and by default 33 of them: none, of links cut and services frozen each module alone, each leg, four
drawn by a fixed seed and all six at once; of either direction alone two drawn and all six. Every
case goes on from one moment of one run, so that none has to stand up first. The push is to the
front left, so a subset is not its own mirror image, and no symmetry is counted on.
"""

from __future__ import annotations

import os
import random
from itertools import chain, combinations
from typing import Any, Final, NamedTuple

import pytest

from services.joint.differential import joint_torque
from services.planner.watch.engagement_fsm import GRACE_NS, WAITS_NS
from shared.bus.messages import Mode, Pair, PlannerStatus
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.scenarios import Inject, Kill, Scenario
from shared.joints import MODULE_INDEX, MODULES, SIDES
from shared.links import Pair as Link
from tests.lockstep.runs import Heard, led_to, modes_of, moment_of, push, restart, run
from tests.robots import ROBOT
from tools.lab.studies.sweeps.figures import Ending, com_max_mm, ending_of, operator_peak_n, step_nm
from tools.sim.lockstep import FleetMoment, Lockstep

BEGIN_S, CUT_S, HEAL_S, END_S = 0.9, 1.0, 2.0, 3.4
"""Scenario times: all cases go on from the first, in the first half of the way down."""
PUSH: Final = push(1.2, 28.0, 28.0, 0.0)
"""40 N to the front left, while what failed is out: no leg mirrors the other."""
LAST_S: Final = 0.3

KINDS: Final = {"links": 4, "commands": 2, "states": 2, "frozen": 4}
"""What fails of each module of a subset, and how many subsets are drawn.

links: both directions between planner and module cut, as if the cable were out. commands: they are
cut, states still come, the module holds by its own age rule. states: they are cut, commands still
come, but echo a stamp that grows old. frozen: the service stopped (SIGSTOP): unheard, its drive
holds by its own loop. A joint service that refuses without a cause there is none: refusing is what
`commands` makes it do.
"""
SUBSETS: Final = [*chain.from_iterable(combinations(MODULES, size) for size in range(1, 7))]
LEGS: Final = [tuple(module for module in MODULES if module.endswith(side)) for side in SIDES]


class PartialCase(NamedTuple):
    kind: str
    modules: tuple[str, ...]


def sample(kind: str) -> list[PartialCase]:
    if os.environ.get("XRL_ALL_SUBSETS"):
        return [PartialCase(kind, modules) for modules in SUBSETS]
    always = [*((module,) for module in MODULES), *LEGS] if kind in ("links", "frozen") else []
    always.append(SUBSETS[-1])
    others = [modules for modules in SUBSETS if modules not in always]
    drawn = random.Random(f"partial {kind}").sample(others, KINDS[kind])
    return [PartialCase(kind, modules) for modules in (*always, *drawn)]


def scenario_of(case: PartialCase) -> Scenario:
    """Return the case as a scenario, from its beginning: `xrl sim` would run it too."""
    pairs = [Link("planner", name) for name in case.modules]
    cut = [pair.there for pair in pairs if case.kind in ("links", "commands")]
    cut += [pair.back for pair in pairs if case.kind in ("links", "states")]
    lasts = {"at": CUT_S, "duration": HEAL_S - CUT_S, "partition": True}
    happens: dict[str, Any] = {"inject": tuple(Inject(link=link, **lasts) for link in cut)}
    if case.kind == "frozen":
        stops = tuple(Kill(service=name, at=CUT_S, signal="STOP") for name in case.modules)
        happens = {"kill": stops, "restart": restart(HEAL_S, *case.modules)}
    return led_to((2.5, 0.948), (5.0, 1.188), duration=END_S, push=(PUSH,), **happens)


class PartialFleet(Lockstep):
    """Compares the drives' torques around each change of mode.

    A service that was frozen does not know its drive's torque: the torque before the change is the
    drive's, not the last one that the service sent.
    """

    torque_step_nm = 0.0
    """Largest change of a joint's torque in the millisecond after a change of mode."""
    _changed: dict[int, Pair] = {}  # noqa: RUF012 - replaced, never changed

    def advance(self) -> None:
        told, changed = len(self.events), self._changed
        super().advance()
        for index, before in changed.items():
            step = step_nm(before, self._torque_of(index))
            self.torque_step_nm = max(self.torque_step_nm, step)
        names = {name for name, _ in self.events[told:]}
        self._changed = {MODULE_INDEX[name]: self._torque_of(MODULE_INDEX[name]) for name in names}

    def _torque_of(self, index: int) -> Pair:
        """Return a module's joint torques, N m, as its drive gives them."""
        a, b = self.bank.torque[2 * index : 2 * index + 2].tolist()
        a_sign, b_sign = self.config.module_named(MODULES[index]).motor_signs
        return joint_torque((a * a_sign, b * b_sign), self.config.joint.gear_ratio)


@pytest.fixture(scope="module")
def start() -> FleetMoment:
    return moment_of(ROBOT, scenario_of(PartialCase("links", ())), BEGIN_S)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "case",
    [PartialCase("links", ()), *(case for kind in KINDS for case in sample(kind))],
    ids=lambda case: f"{case.kind}-{'+'.join(case.modules)}",
)
def test_with_any_subset_failed_all_hold_at_once_nothing_falls_and_all_six_lead_again(
    case: PartialCase, start: FleetMoment
) -> None:
    """With nothing failed no module holds."""
    statuses = Heard(PlannerStatus)
    led_s: list[float] = []

    def look(fleet: Lockstep, row: SimTruth) -> None:
        leads = {*modes_of(fleet)} == {Mode.TRACK} and not statuses[-1].hold
        if not leads:
            led_s.clear()
        elif row.scenario_s > HEAL_S:
            led_s.append(row.scenario_s - HEAL_S)

    scenario, how = scenario_of(case), {"fleet_type": PartialFleet, "record": statuses}
    fleet, rows = run(ROBOT, scenario, start=start, each=look, **how)
    assert ending_of(rows[-1], END_S, ROBOT) is Ending.STOOD
    begin_ns = rows[0].t_ns - round(rows[0].scenario_s * NS_PER_S)
    cut_ns, heal_ns = (begin_ns + round(at * NS_PER_S) for at in (CUT_S, HEAL_S))
    held_ms = [(s.t_ns - cut_ns) / NS_PER_MS for s in statuses if s.hold and s.t_ns >= cut_ns]
    left_ms = {
        name: (event.t_ns - cut_ns) / NS_PER_MS
        for name, event in fleet.events
        if event.mode_before == Mode.TRACK and cut_ns <= event.t_ns < heal_ns
    }
    # while they HOLD the hand leads on against them and comes to its limit, whatever failed
    operator_n = operator_peak_n([r for r in rows if r.scenario_s > rows[-1].scenario_s - LAST_S])
    if not case.modules:
        assert (held_ms, left_ms, fleet.torque_step_nm) == ([], {}, 0.0)
        assert operator_n < 20.0
        return
    age_ms = ROBOT.joint_service.max_command_age_ms
    assert held_ms[0] <= age_ms + 10.0, "hold_all is in the planner's status"
    # a frozen service changes no mode: its drive keeps the last target
    awake = set(MODULES) - set(case.modules if case.kind == "frozen" else ())
    assert awake <= set(left_ms)
    assert max(left_ms.values(), default=0.0) <= age_ms + GRACE_NS / NS_PER_MS
    assert led_s[0] <= WAITS_NS[1] / NS_PER_S
    assert fleet.torque_step_nm <= 5.0
    assert com_max_mm(rows) < 110.0, "90 measured with a leg frozen, of 127 to the sole's end"
    assert operator_n < 75.0, "44 to 50 measured: it leads, and is not at its limit"
