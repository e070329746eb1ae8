"""Short lockstep runs for tests: physics without real time."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.simulator.plant import PlantConfig
from services.simulator.plant import to_toml as plant_to_toml
from services.simulator.state import taken
from shared.bus.messages import SimTruth
from shared.config import scenarios
from shared.config.files import to_toml
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Restart, Scenario
from shared.network.impairment import Impairment
from shared.robot.joints import MODULES
from tests.lockstep.partial import PartialStart
from tools.runs.lockstep import Lockstep
from tools.runs.network import BASE

SCENARIOS = Path(__file__).resolve().parents[2] / "deploy" / "scenarios"


class Run(NamedTuple):
    """A finished run."""

    lockstep: Lockstep
    rows: list[SimTruth]

    @property
    def t(self) -> NDArray[np.float64]:
        return np.array([row.scenario_s for row in self.rows])

    @property
    def com_mm(self) -> NDArray[np.float64]:
        return 1e3 * np.array([row.com for row in self.rows])

    @property
    def angles(self) -> NDArray[np.float64]:
        return np.array([row.angles for row in self.rows])

    @property
    def operator_n(self) -> NDArray[np.float64]:
        return np.array([row.operator_force[2] for row in self.rows])

    @property
    def stood(self) -> bool:
        done = self.rows[-1].scenario_s >= self.lockstep.scenario.duration - 0.1
        return done and not any(row.fallen for row in self.rows)


def variant(name: str, **changes: object) -> Scenario:
    """Return a shipped scenario with fields replaced."""
    return msgspec.structs.replace(scenarios.load(SCENARIOS / f"{name}.toml"), **changes)


def kill(at: float) -> tuple[Kill, ...]:
    return (Kill(service="planner", at=at),)


def restart(at: float) -> tuple[Restart, ...]:
    return (Restart(service="planner", at=at),)


def push(at: float, *force: float) -> Push:
    x, y, z = force
    return Push(at=at, duration=0.3, force=(x, y, z))


def still(duration: float, height: float = 1.188, **changes: object) -> Scenario:
    """Return a scenario in which the hand goes to a height and stays there."""
    frames = (Keyframe(at=0.0, height=1.188), Keyframe(at=2.0, height=height))
    return variant("stand", duration=duration, keyframe=frames, **changes)


def standing(robot: RobotConfig, plant: PlantConfig) -> PartialStart:
    """Return the moment at which a scenario begins; a robot is stood up once in this process."""
    schedule = robot.gain_schedule
    key = (to_toml(robot), plant_to_toml(plant), schedule.digest if schedule else "")
    if key not in _standing:
        fleet = Lockstep(robot, still(1.0), BASE, plant=plant)
        assert any(row.scenario_s >= 0.0 for row in fleet.run()), "it stands and tracks"
        assert fleet.planner is not None
        _standing[key] = PartialStart(
            taken(fleet.world, fleet.bank, fleet.now_ns, 0),
            {module: fleet.snapshot_of(module) for module in MODULES},
            (fleet.planner.session, fleet.planner.snapshot()),
        )
    return _standing[key]


_standing: dict[tuple[str, str, str], PartialStart] = {}


def run(
    robot: RobotConfig,
    scenario: Scenario,
    delay_ms: float = BASE.delay_ms,
    plant: PlantConfig | None = None,
    *,
    stands: bool = True,
) -> Run:
    """Run to the end, or to a fall.

    On the network of the stand-up it begins standing, unless that is not to be taken for granted.
    """
    lockstep = Lockstep(robot, scenario, Impairment(delay_ms=delay_ms), plant=plant)
    if stands and delay_ms == BASE.delay_ms:
        start = standing(robot, lockstep.plant)
        lockstep.resume(start.state, start.modules, start.planner)
    rows = []
    for row in lockstep.run():
        if row.scenario_s >= 0.0:
            rows.append(row)
        if row.fallen:
            break
    return Run(lockstep, rows)
