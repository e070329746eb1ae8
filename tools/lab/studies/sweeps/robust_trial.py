"""One trial of the robustness study: a plant with every error drawn, led, pushed and killed."""

from __future__ import annotations

import math
import random
from typing import Final

import msgspec

from services.simulator.physics.plant import PlantConfig, changed
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Scenario
from tools.lab.studies.sweeps import plants
from tools.lab.studies.sweeps.figures import (
    NOBODY,
    Ended,
    Ending,
    Observer,
    com_max_mm,
    ending_of,
    event_steps_nm,
    operator_peak_n,
    scalars,
    sole_tilt_max_rad,
)
from tools.lab.studies.sweeps.push_range import PushRange, uniform
from tools.sim.lockstep import Lockstep

KINDS: Final = ("squat", "crawl", "lean")
DELAY_MAX_MS: Final = 10.0
LEAD_S: Final = 2.0
"""Each way of a squat; the crawl takes twice that."""
LEAN_SHARE: Final = (0.15, 0.4)
LEAN_S: Final = 1.5
"""A push that lasts, while the planner leads."""
PUSH_SHARE: Final = (0.3, 1.0)
"""Shares of the hardest push that is drawn (`PushRange`)."""
PUSH_S: Final = 0.3
AFTER_KILL_S: Final = 2.5


class RobustTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A trial; the plant follows from seed, number and `beyond`."""

    number: int
    seed: int
    beyond: float
    """Times the ranges of `deploy/plants/ranges.toml`."""
    slope_deg: float
    """The floor's slope, in a direction that is drawn; 0: as the ranges have it."""
    kind: str
    kill_s: float
    delay_ms: float
    pushes: tuple[Push, ...]


class RobustResult(Ended, frozen=True, kw_only=True):
    """The figures of a trial; None where there is nothing to measure."""

    operator_peak_n: float | None = None
    """Vertical force of the hand while the planner leads."""
    com_led_max_mm: float | None = None
    """Largest horizontal distance of the COM from the middle of the ankles, led."""
    com_held_max_mm: float | None = None
    """The same after the kill."""
    sole_tilt_max_rad: float | None = None
    hold_step_nm: float | None = None
    """Largest step of a joint's torque at a change of mode after the start."""


def draw(
    pushes: PushRange, seed: int, number: int, beyond: float = 1.0, slope_deg: float = 0.0
) -> RobustTrial:
    """Return one trial; no other trial has to be drawn for it."""
    dice = random.Random(f"robust {seed} {number}")
    kind = KINDS[number % len(KINDS)]
    way = 2.0 * LEAD_S
    kill = uniform(dice, 0.6 * way, 1.2 * way)
    share, lasting = (LEAN_SHARE, LEAN_S) if kind == "lean" else (PUSH_SHARE, PUSH_S)
    led = pushes.draw(dice, share, 1.0, lasting)
    held = pushes.draw(dice, PUSH_SHARE, kill + uniform(dice, 0.2, 0.8), PUSH_S)
    return RobustTrial(
        number=number,
        seed=seed,
        beyond=beyond,
        slope_deg=slope_deg,
        kind=kind,
        kill_s=kill,
        delay_ms=uniform(dice, 0.5, DELAY_MAX_MS),
        pushes=(led, held),
    )


def plant_of(trial: RobustTrial) -> PlantConfig:
    """Return the trial's true robot."""
    seed = f"robust {trial.seed} {trial.number}"
    plant = plants.draw(seed, beyond=trial.beyond)
    if trial.slope_deg == 0.0:
        return plant
    angle = uniform(random.Random(f"slope {seed}"), -math.pi, math.pi)
    slope = math.radians(trial.slope_deg)
    towards = [round(slope * part, 6) for part in (math.cos(angle), math.sin(angle))]
    return changed(plant, {"floor.slope": towards})


def scenario_of(robot: RobotConfig, trial: RobustTrial) -> Scenario:
    """Return what happens."""
    stand = robot.simulation.stand_height
    ways = {
        "crawl": (Keyframe(2.0 * LEAD_S, 0.79, pitch=1.2, assist=robot.assist.force_max),),
        "squat": (Keyframe(LEAD_S, 0.948), Keyframe(2.0 * LEAD_S, stand)),
        "lean": (Keyframe(LEAD_S, 1.05),),
    }
    return Scenario(
        name=f"robust-{trial.seed}-{trial.number}",
        about=f"trial {trial.number} of `xrl study robust --seed {trial.seed}`",
        duration=round(trial.kill_s + AFTER_KILL_S, 3),
        keyframe=(Keyframe(0.0, stand), *ways[trial.kind]),
        kill=(Kill(service="planner", at=trial.kill_s),),
        push=trial.pushes,
    )


def run_trial(trial: RobustTrial, robot: RobotConfig, observer: Observer = NOBODY) -> RobustResult:
    """Run a trial to its end or to the fall, and measure it."""
    fleet = Lockstep(
        robot,
        scenario_of(robot, trial),
        Impairment(delay_ms=trial.delay_ms),
        seed=trial.number,
        record=observer.record,
        plant=plant_of(trial),
    )
    rows = list(observer.rows_that_count(fleet.run(), 0.0))
    if not rows or rows[0].scenario_s < 0.0:
        return RobustResult(ending=Ending.FELL if rows else Ending.UNREADY)
    last = rows[-1]
    led = [row for row in rows if row.scenario_s < trial.kill_s]
    held = [row for row in rows if row.scenario_s >= trial.kill_s]
    events = [event for _, event in fleet.events if rows[0].t_ns <= event.t_ns <= last.t_ns]
    return RobustResult(
        ending=ending_of(last, fleet.scenario.duration, robot),
        fell_at_s=last.scenario_s if last.fallen else None,
        operator_peak_n=operator_peak_n(led),
        com_led_max_mm=com_max_mm(led),
        com_held_max_mm=com_max_mm(held) if held else None,
        sole_tilt_max_rad=sole_tilt_max_rad(rows),
        hold_step_nm=max(event_steps_nm(events), default=None),
    )


def row_of(trial: RobustTrial) -> dict[str, object]:
    """Return every draw by its column: the trial's, then the plant's errors."""
    row = scalars(trial)
    for name, push in zip(("led", "held"), trial.pushes, strict=True):
        row |= {f"push_{name}_x_n": push.force[0], f"push_{name}_y_n": push.force[1]}
    return row | dict(plants.errors_of(plant_of(trial)))
