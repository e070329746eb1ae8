"""What a planner receives: states of six modules, wrenches; and how it comes to lead by them."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import msgspec
import numpy as np

from services.planner.law.hocca import Hocca, LawInputs, LawOutput, LawState
from services.planner.law.kinematics import Kinematics
from services.planner.planner import Planner
from shared.arrays import Array
from shared.bus.messages import JointState, PlannerMode, Wrench
from shared.clock import NS_PER_MS
from shared.config import files as config_file
from shared.config.gain_schedule import digest_of, inputs_of
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import N_MODULES
from tests import messages
from tests.conftest import ROBOT_FILE

SESSION = 4711
START_NS = 10**12
TICK_NS = 4 * NS_PER_MS
DT = 0.004
"""s; the same."""
STILL: Array = np.zeros(12)
WEIGHT: Array = np.array([0.0, 0.0, 731.6, 0.0, 0.0, 0.0])
"""The shipped robot's along p, N and N m."""


class Kept:
    """A part of the planner together with its state: its functions lack their first argument."""

    def __init__(self, part: Any, state: Any) -> None:
        self.part, self.state = part, state

    def __getattr__(self, name: str) -> Any:
        return partial(getattr(self.part, name), self.state)


class Law:
    """The shipped law together with its state."""

    def __init__(self, robot: RobotConfig) -> None:
        self.hocca, self.state = Hocca(robot), LawState()

    def tick(
        self, q: Array, v: Array = STILL, assist: float = 0.0, dt: float = DT, **more: Any
    ) -> LawOutput:
        """Run the law once."""
        return self.hocca.tick(self.state, LawInputs(q, v, dt, assist=assist, **more))


def with_law(robot: RobotConfig, **changes: object) -> RobotConfig:
    """Return the robot with some keys of [law] changed."""
    return msgspec.structs.replace(robot, law=msgspec.structs.replace(robot.law, **changes))


def requiring(robot: RobotConfig, **changes: object) -> RobotConfig:
    """Return the robot with some keys of [certificate] changed, its schedule made out to fit."""
    certificate = msgspec.structs.replace(robot.certificate, **changes)
    changed = msgspec.structs.replace(robot, certificate=certificate)
    schedule = robot.gain_schedule
    assert schedule is not None
    inputs = inputs_of(changed)
    fitting = msgspec.structs.replace(schedule, inputs=inputs, digest=digest_of(inputs))
    return msgspec.structs.replace(changed, gain_schedule=fitting)


@cache
def shipped() -> tuple[RobotConfig, Kinematics]:
    robot = config_file.load(ROBOT_FILE)
    return robot, Kinematics(robot)


@cache
def standing_torque(q: tuple[float, ...]) -> Array:
    """Return the torques (12,) of the shipped robot's stand at q (12,), rad; N m."""
    robot, kinematics = shipped()
    kinematics.update(np.array(q))
    return np.asarray(robot.total_mass * GRAVITY * kinematics.J[2])


def state(module: int, q: Array, seq: int = 1, **changes: object) -> JointState:
    """Return the state of a module of a robot that stands on its feet."""
    tau = standing_torque(tuple(q.tolist())) if np.isfinite(q).all() else np.zeros(12)
    own = slice(2 * module, 2 * module + 2)
    fields: dict[str, object] = {
        "t_ns": 1000 * (module + 1) + seq, "seq": seq, "session": SESSION, "cause": 0,
        "q": tuple(q[own].tolist()), "v": (0.0, 0.0), "tau": tuple(tau[own].tolist()),
    }  # fmt: skip
    return messages.joint_state(**(fields | changes))


def receive_all(planner: Planner, q: Array, now_ns: int, seq: int = 1, **changes: object) -> None:
    for module in range(N_MODULES):
        planner.receive_state(module, state(module, q, seq, **changes), now_ns)


def receive_but(
    planner: Planner, module: int, q: Array, now_ns: int, seq: int, **changes: object
) -> None:
    """Have six states received, one of them with fields changed."""
    for index in range(N_MODULES):
        own = changes if index == module else {}
        planner.receive_state(index, state(index, q, seq, **own), now_ns)


def lead(planner: Planner, q: Array, now_ns: int = START_NS) -> int:
    """Bring the planner to lead; return the time of its last tick."""
    for tick in range(3):
        now_ns += TICK_NS
        receive_all(planner, q, now_ns, seq=tick)
        planner.tick(now_ns)
    assert planner.status(now_ns, 0.0).mode == PlannerMode.LEADING
    return now_ns


def wrench(force_z: float = 0.0, **changes: object) -> Wrench:
    """Return a reading of the harness, valid unless told otherwise."""
    pull = {"force": (0.0, 0.0, force_z), "moment": (0.0, 0.0, 0.0), "age_ns": 0}
    return messages.wrench(**(pull | changes))
