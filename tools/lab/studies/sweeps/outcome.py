"""One case of the kill study, run in lockstep and measured."""

from __future__ import annotations

import numpy as np

from services.simulator.physics.plant import PlantConfig
from services.simulator.physics.world import World
from shared.bus.messages import (
    JointEvent,
    Message,
    Mode,
    PlannerStatus,
    RunEvent,
    RunEventKind,
    SimTruth,
)
from shared.bus.topics import Topic
from shared.clock import NS_PER_MS
from shared.config.robot_config import RobotConfig
from shared.joints import MODULES, SIDES
from tools.lab.studies.sweeps import plants
from tools.lab.studies.sweeps.cases import KillCase, network_of, scenario_of
from tools.lab.studies.sweeps.figures import (
    Ended,
    Ending,
    com_max_mm,
    ending_of,
    event_steps_nm,
    operator_peak_n,
    sole_tilt_max_rad,
    that_count,
)
from tools.sim.lockstep import Lockstep, Watch
from tools.sim.virtual_time import Record


class KillResult(Ended, frozen=True, kw_only=True):
    """The figures of a case; None where there is nothing to measure.

    "After" is from the kill on, "before" from the scenario's start to the kill.
    """

    kill_height_m: float | None = None
    """Torso, as it was at the kill."""
    kill_pitch_rad: float | None = None
    kill_margin: float | None = None
    """Failsafe certificate of the last commands (docs/law.md#certificate)."""
    kill_margin_onboard: float | None = None
    holds_before: int = 0
    """Drop-outs from TRACK of the busiest module, the planner alive."""
    operator_peak_before_n: float | None = None
    """Vertical force of the hand."""
    com_before_max_mm: float | None = None
    """Largest horizontal distance of the COM from the middle of the ankles."""
    hold_ms: float | None = None
    """From the kill to HOLD, slowest module; None if one held already."""
    torque_step_nm: float | None = None
    """Largest step of a joint's torque at the hand-over."""
    foot_load_min_n: float | None = None
    """Smallest normal force under either foot, after."""
    com_x_min_mm: float | None = None
    com_x_max_mm: float | None = None
    com_y_min_mm: float | None = None
    com_y_max_mm: float | None = None
    com_max_mm: float | None = None
    roll_max_rad: float | None = None
    yaw_max_rad: float | None = None
    sole_tilt_max_rad: float | None = None
    slip_max_mm: float | None = None
    """Largest distance of an ankle from its first place, mm."""


class KillRecorder:
    """Collects from the messages what the verdict needs, and passes all of them on."""

    def __init__(self, on_to: Record | None) -> None:
        self._on_to = on_to
        self.kill_ns: int | None = None
        self.status: PlannerStatus | None = None
        """The planner's last."""

    def __call__(self, topic: Topic, module: str, message: Message) -> None:
        """Take a message as the bus would."""
        if isinstance(message, PlannerStatus):
            self.status = message
        elif isinstance(message, RunEvent) and message.kind == RunEventKind.KILLED:
            self.kill_ns = message.t_ns
        if self._on_to is not None:
            self._on_to(topic, module, message)


def plant_of(case: KillCase) -> PlantConfig:
    """Return the case's true robot: all errors drawn."""
    return plants.draw(f"kill {case.seed} {case.number}")


def run_case(
    case: KillCase,
    robot: RobotConfig,
    *,
    record: Record | None = None,
    watch: Watch | None = None,
    after_fall_s: float = 0.0,
) -> KillResult:
    """Run a case to its end or to the fall.

    Args:
        case: the case.
        robot: with the case's payload, ready to run (`tools.lab.studies.sweeps.prepare`).
        record: takes every message.
        watch: sees the world at its rate.
        after_fall_s: time to continue after a fall; measurement ends with the fall.
    """
    monitor = KillRecorder(record)
    fleet = Lockstep(
        robot,
        scenario_of(robot, case),
        network_of(case),
        seed=case.number,
        record=monitor,
        plant=plant_of(case),
    )
    feet = FootLoads(fleet.world)
    rows: list[SimTruth] = []
    loads: list[float] = []

    def see(row: SimTruth) -> None:
        if case.let_go_s is not None and row.scenario_s >= case.let_go_s:
            fleet.world.let_go()
        if watch is not None:
            watch(row)

    for row in that_count(fleet.run(), 0.0, see, after_fall_s):
        rows.append(row)
        loads.append(min(feet.read()))
    return measure(case, rows, loads, fleet.events, monitor, robot)


class FootLoads:
    """The normal force under each foot."""

    def __init__(self, world: World) -> None:
        """Find the soles."""
        self._data = world.data
        self._soles = [world.model.geom(f"sole_{side}").id for side in SIDES]

    def read(self) -> tuple[float, float]:
        """Return (right, left), N.

        With the model's elliptic friction cones a contact's first constraint force is its
        normal force.
        """
        contact, force = self._data.contact, self._data.efc_force
        loads = [0.0, 0.0]
        for (a, b), address in zip(contact.geom, contact.efc_address, strict=True):
            for foot, sole in enumerate(self._soles):
                if sole in (a, b) and address >= 0:
                    loads[foot] += float(force[address])
        return loads[0], loads[1]


def measure(
    case: KillCase,
    rows: list[SimTruth],
    loads: list[float],
    events: list[tuple[str, JointEvent]],
    monitor: KillRecorder,
    robot: RobotConfig,
) -> KillResult:
    """Return the figures of a run.

    Args:
        case: the case.
        rows: the world since the scenario's start, or the fall before it.
        loads: of the lighter foot, at each row, N.
        events: every change of mode, by module.
        monitor: the other messages.
        robot: for the size of its feet.
    """
    if not rows or rows[0].scenario_s < 0.0:
        return KillResult(ending=Ending.FELL if rows else Ending.UNREADY)
    last = rows[-1]
    figures = _before([row for row in rows if row.scenario_s < case.kill_s])
    after = [row for row in rows if row.scenario_s >= case.kill_s]
    if after and monitor.kill_ns is not None:
        figures |= _after(after) | _handover(events, monitor.kill_ns)
        figures["foot_load_min_n"] = min(loads[-len(after) :])
    if monitor.status is not None:
        figures["kill_margin"] = monitor.status.margin
        figures["kill_margin_onboard"] = monitor.status.margin_onboard
    start_ns = rows[0].t_ns
    until_ns = monitor.kill_ns if monitor.kill_ns is not None else rows[-1].t_ns
    return KillResult(
        ending=ending_of(last, case.end_s, robot),
        fell_at_s=last.scenario_s if last.fallen else None,
        holds_before=_drop_outs(events, start_ns, until_ns),
        **figures,
    )


def _before(rows: list[SimTruth]) -> dict[str, float]:
    if not rows:
        return {}
    return {
        "operator_peak_before_n": operator_peak_n(rows),
        "com_before_max_mm": com_max_mm(rows),
    }


def _after(rows: list[SimTruth]) -> dict[str, float]:
    x, y = 1e3 * np.array([row.over for row in rows]).T
    return {
        "kill_height_m": rows[0].torso[2],
        "kill_pitch_rad": rows[0].angles[1],
        "com_x_min_mm": float(x.min()),
        "com_x_max_mm": float(x.max()),
        "com_y_min_mm": float(y.min()),
        "com_y_max_mm": float(y.max()),
        "com_max_mm": com_max_mm(rows),
        "roll_max_rad": max(abs(row.angles[0]) for row in rows),
        "yaw_max_rad": max(abs(row.angles[2]) for row in rows),
        "sole_tilt_max_rad": sole_tilt_max_rad(rows),
        "slip_max_mm": 1e3 * max(row.feet_slip for row in rows),
    }


def _drop_outs(events: list[tuple[str, JointEvent]], from_ns: int, to_ns: int) -> int:
    count = dict.fromkeys(MODULES, 0)
    for module, event in events:
        count[module] += from_ns <= event.t_ns < to_ns and _into_hold(event)
    return max(count.values())


def _handover(events: list[tuple[str, JointEvent]], kill_ns: int) -> dict[str, float]:
    late = {m: e for m, e in reversed(events) if e.t_ns >= kill_ns and _into_hold(e)}
    figures = {}
    if len(late) == len(MODULES):
        figures["hold_ms"] = max(event.t_ns - kill_ns for event in late.values()) / NS_PER_MS
    steps = event_steps_nm(late.values())
    if steps:
        figures["torque_step_nm"] = max(steps)
    return figures


def _into_hold(event: JointEvent) -> bool:
    return event.mode_before == Mode.TRACK and event.mode_after == Mode.HOLD
