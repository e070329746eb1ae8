"""Short lockstep runs for tests: physics without real time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import SimTruth
from shared.config import scenarios
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Restart, Scenario
from tools.sim.lockstep import Lockstep
from tools.sim.network import BASE
from tools.sim.standing_start import begin_standing

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


def at_rest(rows: Sequence[SimTruth], seconds: float = 1.5) -> bool:
    """Return True if the torso has not moved for some time: by 1 mm, by 1 mrad."""
    count = round(100 * seconds)  # the world is seen at 100 Hz
    if len(rows) < count or len(rows) % 10:
        return False
    last = rows[-count::10]
    moved = np.ptp([(*row.torso, *row.angles) for row in last], axis=0)
    return bool(moved.max() < 1e-3)


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
        assert begin_standing(lockstep), "it stands and tracks"
    rows = []
    for row in lockstep.run():
        if row.scenario_s >= 0.0:
            rows.append(row)
        if row.fallen:
            break
    return Run(lockstep, rows)
