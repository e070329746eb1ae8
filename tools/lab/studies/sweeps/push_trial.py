"""One point of the push envelope: the hardest push that one robot in one pose stands, by bisection.

The robot is stood up, led to the pose and, if the planner is to be dead, left by it. Each push
begins from that same moment.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from services.planner.law.split import ScheduledGains
from services.simulator.physics.plant import PlantConfig
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Scenario
from shared.exceptions import RunError
from tools.lab.design.poses import Poses
from tools.lab.design.push_limit import PushLimits, limits_along, stand_at
from tools.lab.studies.sweeps.figures import NOBODY, Ending, ending_of
from tools.lab.studies.sweeps.push_range import com_height
from tools.sim.lockstep import FleetMoment, Lockstep
from tools.sim.network import BASE

POSES: Final = {"stand": (1.188, 0.0), "squat": (0.95, 0.0), "crawl": (0.79, 1.2)}
"""Torso height, m, and pitch, rad."""
MODES: Final = ("led", "dead")
"""While the planner leads, and with the planner dead."""
REACHED_S: Final = 2.5
"""Scenario time at which the pose is reached."""
LEFT_S: Final = 3.5
"""Scenario time of the planner's kill."""
BEGIN_S: Final = 4.5
"""Scenario time at which the push begins."""
REST_S: Final = 2.0
"""So long after the push a robot that is to fall has fallen, or is tipping."""
FORCE_MAX_N: Final = 240.0
STEP_N: Final = 5.0


class PushTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A point of the envelope."""

    number: int
    pose: str
    angle_deg: int
    """Direction of the push: 0 forwards, 90 to the left."""
    duration_s: float
    mode: str


class PushResult(msgspec.Struct, frozen=True, kw_only=True):
    """How hard a push is stood."""

    stood_n: float
    """The hardest that it stood, N; 0 if none."""
    fell_n: float | None
    """The lightest that it fell at, within `STEP_N` of it; None: it stood them all."""
    held_limit_n: float
    """What its gains bear if the push lasts (`tools.lab.design.push_limit`): HOLD's, into which a
    led robot trips but for a push straight forwards or back."""
    held_part: str
    """What gives way then."""
    body_limit_n: float
    """What soles and motors bear in this pose if the push lasts, whatever the control."""


def scenario_of(trial: PushTrial, force_n: float) -> Scenario:
    """Return what happens for a push of this force."""
    height, pitch = POSES[trial.pose]
    angle = math.radians(trial.angle_deg)
    push = Push(
        at=BEGIN_S,
        duration=trial.duration_s,
        force=(force_n * math.cos(angle), force_n * math.sin(angle), 0.0),
    )
    return Scenario(
        name=f"push-{trial.number}",
        about=f"{trial.pose}, {trial.mode}, {force_n:g} N at {trial.angle_deg} degrees",
        duration=BEGIN_S + trial.duration_s + REST_S,
        keyframe=(
            Keyframe(at=0.0, height=POSES["stand"][0]),
            Keyframe(at=REACHED_S, height=height, pitch=pitch),
        ),
        kill=(Kill(service="planner", at=LEFT_S),) if trial.mode == "dead" else (),
        push=(push,) if force_n > 0.0 else (),
    )


def run_trial(trial: PushTrial, robot: RobotConfig, plant: PlantConfig) -> PushResult:
    """Find the hardest push by bisection.

    Raises:
        RunError: the robot does not come to the pose.
    """
    start = _start_of(trial, robot, plant)
    stood, fell = 0.0, FORCE_MAX_N + STEP_N
    while fell - stood > STEP_N:
        force = STEP_N * round(0.5 * (stood + fell) / STEP_N)
        if _stands(trial, robot, plant, start, force):
            stood = force
        else:
            fell = force
    limits = limits_of(trial, robot)
    trips = trial.angle_deg % 180 != 0
    held = limits.led if trial.mode == "led" and not trips else limits.held
    return PushResult(
        stood_n=stood,
        fell_n=fell if fell <= FORCE_MAX_N else None,
        held_limit_n=held.force_n,
        held_part=held.part,
        body_limit_n=limits.body.force_n,
    )


def limits_of(trial: PushTrial, robot: RobotConfig) -> PushLimits:
    """Return the static limits of the trial's pose and direction, on the robot file's robot."""
    schedule = robot.gain_schedule
    if schedule is None:
        raise RunError("the robot has no gain schedule; run `xrl gains`")
    height, pitch = POSES[trial.pose]
    poses, scheduled = Poses(robot), ScheduledGains(schedule)
    z = com_height(poses, height, pitch)
    stand = stand_at(robot, poses, z, pitch)
    if stand is None:
        raise RunError(f"{trial.pose}: this robot does not reach it")
    angle = math.radians(trial.angle_deg)
    direction = (math.cos(angle), math.sin(angle))
    return limits_along(stand, robot, scheduled.at(z, pitch), scheduled.D_B, direction)


def _start_of(trial: PushTrial, robot: RobotConfig, plant: PlantConfig) -> FleetMoment:
    fleet = Lockstep(robot, scenario_of(trial, 0.0), BASE, plant=plant)
    for truth in fleet.run():
        if truth.fallen:
            raise RunError(f"{trial.pose}: the robot fell before it was pushed")
        if truth.scenario_s >= BEGIN_S - 0.1:
            break
    if fleet.world.scenario_s < BEGIN_S - 0.1:
        raise RunError(f"{trial.pose}: the six modules never came to track")
    moment = fleet.moment()
    return moment if trial.mode == "led" else msgspec.structs.replace(moment, planner=None)


def _stands(
    trial: PushTrial, robot: RobotConfig, plant: PlantConfig, start: FleetMoment, force_n: float
) -> bool:
    scenario = scenario_of(trial, force_n)
    fleet = Lockstep(robot, msgspec.structs.replace(scenario, kill=()), BASE, plant=plant)
    fleet.resume(start)
    rows = list(NOBODY.rows_that_count(fleet.run(), -math.inf))
    return bool(rows) and ending_of(rows[-1], scenario.duration, robot) is Ending.STOOD
