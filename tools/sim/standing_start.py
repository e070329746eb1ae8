"""Runs in lockstep that begin where the robot stands and all six track, not on the hoist.

To stand up takes 3.6 s of each run. Where many runs of one robot on one plant follow each other, it
is stood up once in each process, and each run goes on from there. How it stands up is what
`tests/lockstep/test_dead_services.py` and the sweeps over drawn plants are about: they begin on
the hoist.
"""

from __future__ import annotations

from typing import Final

from services.simulator.physics.plant import PlantConfig
from services.simulator.physics.plant import to_toml as plant_to_toml
from shared.config.files import to_toml
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Scenario
from tools.sim.lockstep import FleetMoment, Lockstep
from tools.sim.network import BASE

NOTHING_HAPPENS: Final = Scenario(
    name="stand", about="nothing happens", duration=1.0, keyframe=(Keyframe(at=0.0, height=1.188),)
)


def begin_standing(fleet: Lockstep) -> bool:
    """Put a new fleet where its scenario begins.

    Returns:
        False if this robot is never led on this plant: it then begins on the hoist.
    """
    start = standing(fleet.config, fleet.plant)
    if start is not None:
        fleet.resume(start)
    return start is not None


def standing(robot: RobotConfig, plant: PlantConfig) -> FleetMoment | None:
    """Return the moment at which a scenario begins; None if it never does.

    Args:
        robot: ready to run.
        plant: the true robot; the network is `BASE`.
    """
    schedule = robot.gain_schedule
    key = (to_toml(robot), plant_to_toml(plant), schedule.digest if schedule else "")
    if key not in _known:
        _known[key] = _stood_up(robot, plant)
    return _known[key]


_known: dict[tuple[str, str, str], FleetMoment | None] = {}


def _stood_up(robot: RobotConfig, plant: PlantConfig) -> FleetMoment | None:
    fleet = Lockstep(robot, NOTHING_HAPPENS, BASE, plant=plant)
    if not any(row.scenario_s >= 0.0 for row in fleet.run()) or fleet.planner is None:
        return None
    return fleet.moment()
