"""One trial of the heat study: a pose held on a drawn plant until the robot stands up by itself.

Thermal time constants are minutes: while the pose is held still, time passes for the temperatures
alone (`Lockstep.skip_heat`), true and estimated, until the robot is about to act. From there on
everything runs in real proportion.
"""

from __future__ import annotations

import random
from typing import Final, Literal

import msgspec

from services.simulator.physics.plant import PlantConfig, changed
from shared.bus.messages import LEFT_MAX_S, STRAIGHT, HandLead, HeatAction
from shared.bus.traces import SimTruth
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from tools.lab.studies.sweeps import plants
from tools.lab.studies.sweeps.figures import (
    NOBODY,
    Ended,
    Ending,
    Observer,
    ending_of,
    operator_peak_n,
    scalars,
)
from tools.lab.studies.sweeps.plants import ErrorRange, Ranges
from tools.lab.studies.sweeps.push_range import uniform
from tools.sim.lockstep import Lockstep

PersonKind = Literal["follows", "clings", "leaves"]
PEOPLE: Final[tuple[PersonKind, ...]] = ("follows", "clings", "leaves")
"""Takes weight off when told, and stands up with it; keeps weight and hand where they are; takes
the weight and then the hand off, once the pose is held."""
LEAD_S: Final = 3.0
HELD_S: Final = 8.0
"""Time for which the pose is held before time is skipped: the mean load has settled."""
AHEAD_S: Final = 3.0
"""Seconds left beyond those at which the robot acts, at the end of the skipped time."""
SKIP_MAX_S: Final = 7200.0
"""A pose that lasts so long lasts."""
REACTS_S: Final = 2.0
"""Time in which a person who follows does what is said."""
RESTED_S: Final = 25.0
"""The trial ends so long after the robot rests: it then gives the height back, or does not."""
DURATION_S: Final = 150.0
AMBIENT: Final = (20.0, 45.0)
HEAT_ERRORS: Final = (
    ErrorRange("heat.resistance", 0.09, 0.11),
    ErrorRange("heat.winding_capacity", 80.0, 125.0, "log"),
    ErrorRange("heat.winding_to_housing", 0.4, 0.625, "log"),
    ErrorRange("heat.housing_capacity", 1200.0, 1875.0, "log"),
    ErrorRange("heat.housing_to_air", 0.96, 1.5, "log"),
    ErrorRange("heat.stage_per_square_ampere", 0.045, 0.065),
    ErrorRange("heat.stage_s", 100.0, 300.0, "log"),
)
"""A quarter either way about the robot file's figures, a tenth for the resistance."""
INSULATION: Final = 155.0
"""C; class F. A winding beyond it is lost."""


class HeatTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A trial; the plant's other errors follow from seed and number."""

    number: int
    seed: int
    ambient: float
    height: float
    """Height of the torso, m."""
    pitch: float
    assist: float
    """N"""
    payload_scale: float
    person: PersonKind
    reports: bool
    """The drives report their thermistors (firmware 0.6), the motors have some, and derate by
    them; False: firmware 0.5 on CAN, which reports none."""


class HeatResult(Ended, frozen=True, kw_only=True):
    """The figures of a trial; None where there is nothing to measure."""

    held_s: float | None = None
    """How long the pose was held before the robot stood up by itself; None: it did not, in two
    hours, or as the person took the weight off in time."""
    told_s: float | None = None
    """How long the person was told before."""
    rose_s: float | None = None
    """From then until it was straight; None: it never was."""
    winding_max: float = 0.0
    """Warmest true winding, C."""
    stage_max: float = 0.0
    derating_min: float = 1.0
    """Least fraction of a current limit that heat left."""
    unseen: bool = False
    """A drive derated while the planner said nothing."""
    error: float | None = None
    """Estimated less true temperature of the warmest winding as the robot acts, K."""
    operator_peak_n: float | None = None
    com_mm: float | None = None
    """Largest distance of the COM from the middle of the ankles from then on."""


def draw(seed: int, number: int) -> HeatTrial:
    """Return one trial; no other trial has to be drawn for it."""
    dice = random.Random(f"heat {seed} {number}")
    crawls = dice.random() < 0.2
    return HeatTrial(
        number=number,
        seed=seed,
        ambient=uniform(dice, *AMBIENT),
        height=0.79 if crawls else uniform(dice, 0.85, 1.1),
        pitch=1.2 if crawls else 0.0,
        assist=dice.choice((0.0, 200.0)),
        payload_scale=dice.choice((1.0, 1.2)),
        person=PEOPLE[number % len(PEOPLE)],
        reports=dice.random() < 0.5,
    )


def plant_of(trial: HeatTrial) -> PlantConfig:
    """Return the trial's true robot."""
    ranges = Ranges(error=(*plants.shipped().error, *HEAT_ERRORS))
    plant = plants.draw(f"heat {trial.seed} {trial.number}", ranges)
    values = {
        "heat.ambient": trial.ambient,
        "heat.motor_thermistor": trial.reports,
        "body.payload_scale": trial.payload_scale,
    }
    return changed(plant, values)


def robot_of(robot: RobotConfig, trial: HeatTrial) -> RobotConfig:
    """Return the robot with the trial's drives."""
    dialect: Literal["0.5", "0.6"] = "0.6" if trial.reports else "0.5"
    simulation = msgspec.structs.replace(robot.simulation, can_dialect=dialect)
    return msgspec.structs.replace(robot, simulation=simulation)


def scenario_of(robot: RobotConfig, trial: HeatTrial) -> Scenario:
    """Return what happens."""
    held = Keyframe(LEAD_S, trial.height, pitch=trial.pitch, assist=trial.assist)
    return Scenario(
        name=f"heat-{trial.seed}-{trial.number}",
        about=f"trial {trial.number} of `xrl study heat --seed {trial.seed}`",
        duration=DURATION_S,
        keyframe=(Keyframe(0.0, robot.simulation.stand_height), held),
    )


class _Person:
    """What the person does, by what the planner says."""

    def __init__(self, kind: PersonKind, fleet: Lockstep) -> None:
        self._kind, self._fleet = kind, fleet
        self._told_s: dict[HeatAction, float] = {}

    def act(self, row: SimTruth, action: HeatAction) -> None:
        world, now_s = self._fleet.world, row.scenario_s
        self._told_s.setdefault(action, now_s)
        if self._kind == "leaves" and now_s > LEAD_S + 0.3 * HELD_S:
            world.outside.asked = (0.0, STRAIGHT)
            if now_s > LEAD_S + 0.8 * HELD_S:
                world.let_go()
        if self._kind != "follows" or now_s < self._told_s.get(HeatAction.EASES, now_s) + REACTS_S:
            return
        world.outside.asked = (0.0, STRAIGHT)
        stands_s = self._told_s.get(HeatAction.STANDS_UP, now_s) + REACTS_S
        led = world.outside.led_hand
        if now_s >= stands_s and (led is None or not led.leads):
            straight: tuple[float, float, float] = (0.0, 0.0, 0.0)
            up = HandLead(
                t_ns=0, seq=0, leads=True, height=1.2, pitch=row.angles[1], push=straight,
                source="the person",
            )  # fmt: skip
            self._fleet.lead(up)


def run_trial(trial: HeatTrial, robot: RobotConfig, observer: Observer = NOBODY) -> HeatResult:
    """Run a trial until the robot has rested, or fallen, and measure it."""
    robot = robot_of(robot, trial)
    plant = plant_of(trial)
    fleet = Lockstep(
        robot, scenario_of(robot, trial), seed=trial.number, record=observer.record, plant=plant
    )
    heat = fleet.bank.heat
    fleet.bank.settings.fill("motor.motor_thermistor.config.enabled", trial.reports)
    person = _Person(trial.person, fleet)
    rows: list[SimTruth] = []
    since_s: dict[HeatAction, float] = {}
    skipped_s, unseen, error, derating = 0.0, False, None, 1.0
    winding = stage = 0.0
    for row in observer.rows_that_count(fleet.run(), 0.0):
        rows.append(row)
        planner = fleet.planner
        if planner is None:
            continue
        action = HeatAction(planner.status(fleet.now_ns, 0.0).heat)
        since_s.setdefault(action, row.scenario_s)
        derating = min(derating, heat.derating)
        winding = max(winding, float(heat.winding.max()))
        stage = max(stage, float(heat.stage.max()))
        unseen |= heat.derating < 1.0 and action is HeatAction.NONE
        if action is HeatAction.STANDS_UP and error is None:
            shown = max(max(law.heat.state.winding) for law in fleet.controllers)
            error = shown - float(heat.winding.max())
        person.act(row, action)
        if skipped_s == 0.0 and row.scenario_s >= LEAD_S + HELD_S:
            skipped_s = skip(fleet, trial, robot)
            if skipped_s >= SKIP_MAX_S:
                break
        if row.scenario_s >= since_s.get(HeatAction.RESTS, DURATION_S) + RESTED_S:
            break
    if not rows or rows[0].scenario_s < 0.0:
        return HeatResult(ending=Ending.FELL if rows else Ending.UNREADY)
    last = rows[-1]
    stands = since_s.get(HeatAction.STANDS_UP)
    rests = since_s.get(HeatAction.RESTS)
    after = [row for row in rows if stands is not None and row.scenario_s >= stands]
    return HeatResult(
        ending=ending_of(last, last.scenario_s, robot),
        fell_at_s=last.scenario_s if last.fallen else None,
        held_s=None if stands is None else stands - LEAD_S + skipped_s,
        told_s=None if stands is None else stands - since_s.get(HeatAction.EASES, stands),
        rose_s=None if stands is None or rests is None else rests - stands,
        winding_max=winding,
        stage_max=stage,
        derating_min=derating,
        unseen=unseen,
        error=error,
        operator_peak_n=operator_peak_n(after) if after else None,
        com_mm=max((1e3 * max(map(abs, row.over)) for row in after), default=None),
    )


def skip(fleet: Lockstep, trial: HeatTrial, robot: RobotConfig) -> float:
    """Let time pass for the temperatures until the robot is about to act; return how much, s."""
    limit_s = robot.heat.ease_s if trial.assist > 0.0 else robot.heat.stand_s
    passed_s = 0.0
    while passed_s < SKIP_MAX_S:
        left_s = min(law.heat.state.left_s for law in fleet.controllers)
        if left_s < limit_s + AHEAD_S:
            break
        step_s = 60.0 if left_s >= LEFT_MAX_S else 1.0
        fleet.skip_heat(step_s)
        passed_s += step_s
    return max(passed_s, 1e-3)


def row_of(trial: HeatTrial) -> dict[str, object]:
    """Return every draw by its column: the trial's, then the heat's errors."""
    heat = msgspec.to_builtins(plant_of(trial).heat)
    names = [row.key.removeprefix("heat.") for row in HEAT_ERRORS]
    return scalars(trial) | {name: heat[name] for name in names}
