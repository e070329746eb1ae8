"""Partial failures: some of the six modules' links cut or services frozen, the others well.

In virtual time, in the middle of a squat and under a push: every case goes on from one moment
of one run, so that none has to stand up first.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, combinations
from typing import Final, Literal

import msgspec

from services.joint.differential import joint_torque
from shared.bus.messages import Message, Mode, Pair, PlannerStatus
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Inject, Keyframe, Kill, Push, Restart, Scenario
from shared.joints import MODULE_INDEX, MODULES
from shared.links import Pair as Link
from tests.lockstep.runs import moment_of
from tools.lab.studies.sweeps.figures import Ending, com_max_mm, ending_of, operator_peak_n, step_nm
from tools.sim.lockstep import FleetMoment, Lockstep, forget
from tools.sim.virtual_time import Record

FailureKind = Literal["links", "commands", "states", "frozen"]
KINDS: Final[Mapping[FailureKind, str]] = {
    "links": "both directions between planner and module cut: as if the cable were out",
    "commands": "commands cut, states still come: the module holds by its own age rule",
    "states": "states cut, commands still come, but echo a stamp that grows old",
    "frozen": "the service stopped (SIGSTOP): unheard, its drive holds by its own loop",
}
"""What fails, of each module of a subset. A joint service that refuses without a cause there is
none: refusing is what `commands` makes it do."""

SUBSETS: Final = tuple(
    chain.from_iterable(combinations(MODULES, size) for size in range(len(MODULES) + 1))
)
"""All 64; the first is empty: nothing fails."""

BEGIN_S: Final = 0.9
"""Scenario time that all cases go on from, in the first half of the way down."""
CUT_S: Final = 1.0
PUSH: Final = Push(at=1.2, duration=0.3, force=(28.0, 28.0, 0.0))
"""40 N to the front left, while what failed is out: no leg mirrors the other."""
HEAL_S: Final = 2.0
END_S: Final = 3.4
LAST_S: Final = 0.3
SQUAT: Final = (
    Keyframe(at=0.0, height=1.188),
    Keyframe(at=2.5, height=0.948),
    Keyframe(at=5.0, height=1.188),
)


class PartialCase(msgspec.Struct, frozen=True):
    """One partial failure."""

    kind: FailureKind
    modules: tuple[str, ...]


class PartialResult(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a case; None where there was nothing of the kind."""

    stood: bool
    """Neither fallen nor, at the end, tipping."""
    hold_shown_ms: float | None
    """From the cut to the first planner status that says `hold`."""
    track_left_ms: float | None
    """From the cut to when the last module left TRACK; None: one never did before the heal."""
    led_again_s: float | None
    """From the heal until all six track under a planner that leads; None: not by the end."""
    torque_step_nm: float
    """Largest step of a joint's torque at a change of mode, as the drives give it."""
    com_max_mm: float
    """Largest horizontal distance of the COM from between the ankles."""
    operator_end_n: float
    """Most of the hand, vertical, in the run's last `LAST_S`, with all six back in TRACK.

    While they HOLD it leads on against them and comes to its limit, whatever failed.
    """


def scenario_of(case: PartialCase) -> Scenario:
    """Return the case as a scenario, from its beginning: `xrl sim` would run it too."""
    service = [name for name in case.modules if case.kind == "frozen"]
    return Scenario(
        name=f"partial-{case.kind}",
        about=f"{case.kind}: {', '.join(case.modules) or 'none'}",
        duration=END_S,
        keyframe=SQUAT,
        push=(PUSH,),
        kill=tuple(Kill(service=name, at=CUT_S, signal="STOP") for name in service),
        restart=tuple(Restart(service=name, at=HEAL_S) for name in service),
        inject=tuple(
            Inject(link=link, at=CUT_S, duration=HEAL_S - CUT_S, partition=True)
            for name in case.modules
            for link in _links(case.kind, name)
        ),
    )


def _links(kind: FailureKind, module: str) -> tuple[str, ...]:
    pair = Link("planner", module)
    cut: dict[FailureKind, tuple[str, ...]] = {
        "links": (pair.there, pair.back),
        "commands": (pair.there,),
        "states": (pair.back,),
        "frozen": (),
    }
    return cut[kind]


class PartialFleet(Lockstep):
    """Records for the verdict alone, and compares the drives' torques around each change of mode.

    A service that was frozen does not know its drive's torque: the torque before the change is the
    drive's, not the last one that the service sent.
    """

    def __init__(self, config: RobotConfig, scenario: Scenario, record: Record = forget) -> None:
        """Begin as `Lockstep` does."""
        super().__init__(config, scenario, record=record)
        self.torque_step_nm = 0.0
        """Largest change of a joint's torque in the millisecond after a change of mode."""
        self._changed: dict[int, Pair] = {}

    def advance(self) -> None:
        """Go on by one step of the world."""
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


def start_of(robot: RobotConfig) -> FleetMoment:
    """Return the moment that all cases go on from."""
    return moment_of(robot, scenario_of(PartialCase("links", ())), BEGIN_S)


def run_case(case: PartialCase, robot: RobotConfig, start: FleetMoment) -> PartialResult:
    """Go on from the common moment, with the case's failure, to its end or to the fall.

    Args:
        case: what fails.
        robot: ready to run.
        start: of that robot, by `start_of`.
    """
    statuses: list[PlannerStatus] = []

    def receive(_topic: Topic, _module: str, message: Message) -> None:
        if isinstance(message, PlannerStatus):
            statuses.append(message)

    fleet = PartialFleet(robot, scenario_of(case), record=receive)
    fleet.resume(start)
    begin_ns = fleet.now_ns - round(fleet.world.scenario_s * NS_PER_S)
    rows: list[SimTruth] = []
    led_ns = None
    for row in fleet.run():
        rows.append(row)
        if row.fallen:
            break
        modes = {controller.failsafe.mode for controller in fleet.controllers}
        leads = modes == {Mode.TRACK} and not statuses[-1].hold and row.scenario_s > HEAL_S
        led_ns = (led_ns or fleet.now_ns) if leads else None
    return _measure(case, fleet, rows, statuses, begin_ns, led_ns)


def _measure(
    case: PartialCase,
    fleet: PartialFleet,
    rows: list[SimTruth],
    statuses: list[PlannerStatus],
    begin_ns: int,
    led_ns: int | None,
) -> PartialResult:
    cut_ns, heal_ns = (begin_ns + round(at * NS_PER_S) for at in (CUT_S, HEAL_S))
    held = [status.t_ns for status in statuses if status.hold and status.t_ns >= cut_ns]
    left = {
        name: event.t_ns
        for name, event in fleet.events
        if event.mode_before == Mode.TRACK and cut_ns <= event.t_ns < heal_ns
    }
    # a frozen service changes no mode: its drive keeps the last target
    awake = set(MODULES) - set(case.modules if case.kind == "frozen" else ())
    all_left = bool(left) and awake <= set(left)
    last_s = rows[-1].scenario_s - LAST_S
    return PartialResult(
        stood=ending_of(rows[-1], END_S, fleet.config) is Ending.STOOD,
        hold_shown_ms=(held[0] - cut_ns) / NS_PER_MS if held else None,
        track_left_ms=(max(left.values()) - cut_ns) / NS_PER_MS if all_left else None,
        led_again_s=None if led_ns is None else (led_ns - heal_ns) / NS_PER_S,
        torque_step_nm=fleet.torque_step_nm,
        com_max_mm=com_max_mm(rows),
        operator_end_n=operator_peak_n([row for row in rows if row.scenario_s > last_s]),
    )
