"""Short lockstep runs for tests: physics without real time."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.simulator.plant import PlantConfig
from shared import scenario
from shared.config import RobotConfig
from shared.impairment import Impairment
from shared.messages import SimTruth
from shared.scenario import Keyframe, Kill, Push, Restart, Scenario
from tools.runs.lockstep import Lockstep

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


def story(name: str, **changes: object) -> Scenario:
    """Return a shipped scenario with fields replaced."""
    return msgspec.structs.replace(scenario.load(SCENARIOS / f"{name}.toml"), **changes)


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
    return story("stand", duration=duration, keyframe=frames, **changes)


def run(
    robot: RobotConfig,
    scenario: Scenario,
    delay_ms: float = 1.0,
    plant: PlantConfig | None = None,
) -> Run:
    """Run to the end, or to a fall."""
    lockstep = Lockstep(robot, scenario, Impairment(delay_ms=delay_ms), plant=plant)
    rows = []
    for row in lockstep.run():
        if row.scenario_s >= 0.0:
            rows.append(row)
        if row.fallen:
            break
    return Run(lockstep, rows)
