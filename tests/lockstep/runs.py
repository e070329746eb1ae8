"""Short lockstep runs for tests: physics without real time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.simulator.physics.plant import PlantConfig
from shared.bus.messages import Cause, Message, Mode, PlannerStatus, Vector4
from shared.bus.topics import Topic
from shared.bus.traces import SimTruth
from shared.config import scenarios
from shared.config.impairment import Impairment
from shared.config.robot_config import RobotConfig
from shared.config.scenarios import Keyframe, Kill, Push, Restart, Scenario
from shared.robot.trip_table import JOINT_TRIPS
from tools.lab.studies.sweeps.figures import event_steps_nm
from tools.sim.lockstep import FleetMoment, Lockstep, begin_standing, standing
from tools.sim.network import BASE

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
    def height(self) -> NDArray[np.float64]:
        """Height of the torso, m."""
        return np.array([row.torso[2] for row in self.rows])

    @property
    def sinking(self) -> float:
        """Fastest way down of the torso, m/s."""
        return float(-np.gradient(self.height, 0.01).min())  # it is seen at 100 Hz

    @property
    def rising(self) -> float:
        """Fastest way up of the torso, m/s."""
        return float(np.gradient(self.height, 0.01).max())

    @property
    def angles(self) -> NDArray[np.float64]:
        return np.array([row.angles for row in self.rows])

    @property
    def operator_n(self) -> NDArray[np.float64]:
        return np.array([row.operator_force[2] for row in self.rows])

    @property
    def tilt(self) -> float:
        """Largest tilt of a sole, rad."""
        return max(max(row.foot_left_tilt, row.foot_right_tilt) for row in self.rows)

    def steps_nm(self, *but: str, after: Mode | None = None) -> list[float]:
        """Return the step of torque at each change of mode, to `after`, of all modules `but`."""
        return event_steps_nm(
            event
            for module, event in self.lockstep.events
            if module not in but and (after is None or event.mode_after == after)
        )

    @property
    def modes(self) -> list[Mode]:
        return modes_of(self.lockstep)

    @property
    def status(self) -> PlannerStatus:
        return status_of(self.lockstep)

    @property
    def believed(self) -> bool:
        """True if no module refused a command, and neither module nor planner tripped."""
        causes = {event.cause for _, event in self.lockstep.events}
        refused = any(each.failsafe.refused for each in self.lockstep.controllers)
        return not refused and causes.isdisjoint((Cause.HOLD_ALL, *JOINT_TRIPS))

    @property
    def stood(self) -> bool:
        done = self.rows[-1].scenario_s >= self.lockstep.scenario.duration - 0.1
        return done and not any(row.fallen for row in self.rows)


class Heard(list[Message]):
    """A record of the messages of some kinds, in the order in which they came."""

    def __init__(self, *kinds: type[Message]) -> None:
        super().__init__()
        self._kinds = kinds

    def __call__(self, _topic: Topic, _module: str, message: Message) -> None:
        if isinstance(message, self._kinds):
            self.append(message)


def modes_of(fleet: Lockstep) -> list[Mode]:
    return [controller.failsafe.mode for controller in fleet.controllers]


def status_of(fleet: Lockstep) -> PlannerStatus:
    """Return the status of a planner that lives."""
    assert fleet.planner is not None
    return fleet.planner.status(fleet.now_ns, 0.0)


def corner(robot: RobotConfig, signs: Sequence[int]) -> Vector4:
    """Return the farthest lean that may be asked for, in the corner of these signs."""
    x, y, roll, yaw = (sign * most for sign, most in zip(signs, robot.law.shift_max, strict=True))
    return x, y, roll, yaw


def variant(name: str, **changes: object) -> Scenario:
    """Return a shipped scenario with fields replaced."""
    return msgspec.structs.replace(scenarios.load(SCENARIOS / f"{name}.toml"), **changes)


def kill(at: float, *services: str) -> tuple[Kill, ...]:
    return tuple(Kill(service=service, at=at) for service in services or ("planner",))


def restart(at: float, *services: str) -> tuple[Restart, ...]:
    return tuple(Restart(service=service, at=at) for service in services or ("planner",))


def push(at: float, *force: float) -> Push:
    x, y, z = force
    return Push(at=at, duration=0.3, force=(x, y, z))


def led_to(*poses: tuple[Any, ...], duration: float, **changes: object) -> Scenario:
    """Return a scenario in which the hand leads from a stand to poses, and stays in the last.

    A pose has the fields of a `Keyframe` in their order: s, m, rad, N, shift.
    """
    frames = tuple(
        Keyframe(**dict(zip(Keyframe.__struct_fields__, pose, strict=False)))
        for pose in ((0.0, 1.188), *poses)
    )
    return variant("stand", duration=duration, keyframe=frames, **changes)


def still(duration: float, height: float = 1.188, **changes: object) -> Scenario:
    """Return a scenario in which the hand goes to a height and stays there."""
    return led_to((2.0, height), duration=duration, **changes)


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
    network: Impairment | None = None,
    stands: bool = True,
    start: FleetMoment | None = None,
    fleet_type: type[Lockstep] = Lockstep,
    each: Callable[[Lockstep, SimTruth], bool | None] = lambda _fleet, _row: None,
    **how: Any,
) -> Run:
    """Run to the end, to a fall, or until `each`, which sees each row, returns True.

    It goes on from `start`, or begins standing, stood up on the usual network, unless that is not
    to be taken for granted. What else a fleet takes, such as `seed` or `record`, is handed on.
    """
    network = network or Impairment(delay_ms=delay_ms)
    lockstep = fleet_type(robot, scenario, network, plant=plant, **how)
    if start is not None:
        lockstep.resume(start)
    elif stands:
        assert begin_standing(lockstep), "it stands and tracks"
    rows = []
    for row in lockstep.run():
        if row.scenario_s >= 0.0:
            rows.append(row)
        if each(lockstep, row) or row.fallen:
            break
    return Run(lockstep, rows)


def standing_as(robot: RobotConfig, plant: PlantConfig | None = None) -> FleetMoment:
    """Return where runs of a robot begin, for one with other keys to begin there as well."""
    start = standing(robot, plant or PlantConfig())
    assert start is not None, "it stands and tracks"
    return start


def moment_of(robot: RobotConfig, scenario: Scenario, at: float, **how: Any) -> FleetMoment:
    """Return the moment at which a run has come so far; it begins as `run` does."""
    return run(robot, scenario, each=lambda _, row: row.scenario_s >= at, **how).lockstep.moment()
