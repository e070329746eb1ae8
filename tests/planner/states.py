"""Builds what the tests of the planner need: poses, stands, the law, states, wrenches, a lead."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import msgspec
import numpy as np

from services.planner.law.certificate import Certificate
from services.planner.law.hocca import Hocca, LawInputs, LawOutput, LawState
from services.planner.law.kinematics import Kinematics
from services.planner.law.split import GainLaw, GainSplit, JointGains, LocalGains
from services.planner.planner import Planner
from shared.arrays import Array
from shared.bus.messages import JointCommand, JointState, PlannerMode, PlannerStatus, Wrench
from shared.clock import NS_PER_MS
from shared.config import files as config_file
from shared.config.gain_schedule import digest_of, inputs_of
from shared.config.robot_config import GRAVITY, RobotConfig
from shared.joints import N_MODULES
from shared.robot.robot_model import stand_pose
from tests import messages
from tests.conftest import ROBOT_FILE
from tests.planner import oracle
from tools.reach import ReachSolver

ROBOT = config_file.load(ROBOT_FILE)
"""The shipped robot."""
LIMITS: Array = np.array(ROBOT.joint_limits())
SESSION = 4711
START_NS = 10**12
TICK_NS = 4 * NS_PER_MS
DT = 0.004
"""s; the same."""
STILL: Array = np.zeros(12)
WEIGHT: Array = np.array([0.0, 0.0, 731.6, 0.0, 0.0, 0.0])
"""The shipped robot's along p, N and N m."""
KNEES = [3, 9]
"""Indices of the knees' theta among the joints."""
SQUAT = (1.25, 1.188, 1.1, 1.0, 0.948, 0.85)
"""Torso heights over which the robot squats, m."""


# ---- robots


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


# ---- poses


@cache
def shipped_ik() -> ReachSolver:
    """Return the shipped robot's inverse kinematics; each test begins by setting its q."""
    return ReachSolver(Kinematics(ROBOT), LIMITS)


def com_height(robot: RobotConfig, height: float) -> float:
    """Return the COM's height of a level stand with its torso at a height, m."""
    return float(oracle.pose(robot, np.array(stand_pose(robot, height)))[2])


def p_at(robot: RobotConfig, height: float, **parts: float) -> Array:
    """Return p (6,) for a torso height of a level stand, and the other parts as named."""
    x, y, roll, pitch, yaw = (parts.get(n, 0.0) for n in ("x", "y", "roll", "pitch", "yaw"))
    return np.array([x, y, com_height(robot, height), roll, pitch, yaw])


def at_pose(robot: RobotConfig, ik: ReachSolver, p: Array, start: Array) -> Array:
    """Return q (12,) at p, polished until the oracle agrees to 1e-13; asserts it got there."""
    ik.q[:] = start
    for _ in range(3):  # each solve stops at its tolerance; the next goes on from there
        ik.solve(p, iterations_max=60)
    return oracle.closed_chain(robot, ik.q.copy())(p)


@cache
def _closed(height: float, parts: frozenset[tuple[str, float]]) -> Array:
    start = np.array(stand_pose(ROBOT, 1.188))
    return at_pose(ROBOT, shipped_ik(), p_at(ROBOT, height, **dict(parts)), start)


def closed(height: float, **parts: float) -> Array:
    """Return q (12,) of the shipped robot where the legs agree, its torso at a height, m."""
    return _closed(height, frozenset(parts.items())).copy()


class Stand:
    """A robot that stands still at a pose, and a certificate that was moved there."""

    STEP = 1e-4

    def __init__(self, robot: RobotConfig, q: Array, assist: float) -> None:
        """Stand at q with an assist, N."""
        self.robot, self.q, self.p = robot, q, oracle.pose(robot, q)
        self.T = oracle.feasible(robot, q)
        self.kinematics = Kinematics(robot)
        self.kinematics.update(q)
        F_O = np.array([0.0, 0.0, oracle.masses(robot)[1] * oracle.GRAVITY, 0.0, 0.0, 0.0])
        self.F_assist = np.array([0.0, 0.0, assist])
        self.tau_ff = F_O @ self.kinematics.J + self.F_assist @ self.kinematics.J_harness
        self.hessian_O = self.kinematics.hessian_times(F_O, self.F_assist).copy()
        self.certificate = Certificate(robot)
        self.certificate.at(self.T, self.hessian_O)

    def stiffness_felt(self, D: Array) -> Array:
        """Return the curvature (6, 6) of the energy by p, by the oracle; asserts balance.

        The weight, the operator's load pressing down at the harness with what the assist
        lifts, springs D wound about the pose, and torques held as they are there.
        """
        q_of = oracle.closed_chain(self.robot, self.q)

        def energy(p: Array) -> Array:
            q = q_of(p)
            gravity = oracle.potential_energy(self.robot, q)
            load = self.F_assist @ oracle.harness(self.robot, q)
            away = q - self.q
            return np.array(gravity + load + 0.5 * away @ (D * away) - self.tau_ff @ q)

        slope = oracle.precise_derivative(energy, self.p, self.STEP)
        np.testing.assert_allclose(slope, 0.0, atol=2e-5)
        return oracle.second_derivative(energy, self.p, self.STEP)

    def gains(self) -> JointGains:
        """Return K_q and B_q here."""
        return GainLaw(self.robot).gains(self.kinematics, self.hessian_O)

    def split(self, split: GainSplit) -> LocalGains:
        """Return the local gains that a split chooses here."""
        z, pitch = float(self.p[2]), float(self.p[4])
        return split.split(self.gains, z, pitch, self.T, self.hessian_O)


# ---- parts and the law


class Kept:
    """A part of the planner together with its state: its functions lack their first argument."""

    def __init__(self, part: Any, state: Any) -> None:
        self.part, self.state = part, state

    def __getattr__(self, name: str) -> Any:
        return partial(getattr(self.part, name), self.state)


class Law:
    """The shipped law together with its state."""

    def __init__(self, robot: RobotConfig = ROBOT) -> None:
        self.hocca, self.state = Hocca(robot), LawState()

    def tick(
        self, q: Array, v: Array = STILL, assist: float = 0.0, dt: float = DT, **more: Any
    ) -> LawOutput:
        """Run the law once."""
        return self.hocca.tick(self.state, LawInputs(q, v, dt, assist=assist, **more))

    def align(self, q: Array, assist: float = 0.0, **more: Any) -> LawOutput:
        """Run the law once, at rest, while the planner does not lead."""
        return self.tick(q, assist=assist, align=True, **more)


# ---- what a planner receives, and how it comes to lead


@cache
def standing_torque(q: tuple[float, ...]) -> Array:
    """Return the torques (12,) of the shipped robot's stand at q (12,), rad; N m."""
    kinematics = shipped_ik().kinematics
    kinematics.update(np.array(q))
    return np.asarray(ROBOT.total_mass * GRAVITY * kinematics.J[2])


def state(module: int, q: Array, seq: int = 1, **changes: object) -> JointState:
    """Return the state of a module of a robot that stands on its feet."""
    tau = standing_torque(tuple(q.tolist())) if np.isfinite(q).all() else np.zeros(12)
    own = slice(2 * module, 2 * module + 2)
    fields: dict[str, object] = {
        "t_ns": 1000 * (module + 1) + seq, "seq": seq, "session": SESSION, "cause": 0,
        "q": tuple(q[own].tolist()), "v": (0.0, 0.0), "tau": tuple(tau[own].tolist()),
    }  # fmt: skip
    return messages.joint_state(**(fields | changes))


def states(q: Array, *changed: int, **changes: object) -> list[JointState]:
    """Return six states; of the modules named, or of all, some fields are changed."""
    return [
        state(index, q, **(changes if index in (changed or range(N_MODULES)) else {}))
        for index in range(N_MODULES)
    ]


def wrench(force_z: float = 0.0, **changes: object) -> Wrench:
    """Return a reading of the harness, valid unless told otherwise."""
    pull = {"force": (0.0, 0.0, force_z), "moment": (0.0, 0.0, 0.0), "age_ns": 0}
    return messages.wrench(**(pull | changes))


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


def ticked(
    planner: Planner, q: Array, now_ns: int, seq: int = 1, **changes: object
) -> tuple[list[JointCommand], PlannerStatus]:
    """Have six states received, and tick; return commands and status."""
    receive_all(planner, q, now_ns, seq, **changes)
    return planner.tick(now_ns), planner.status(now_ns, 0.0)


def lead(planner: Planner, q: Array, now_ns: int = START_NS) -> int:
    """Bring the planner to lead; return the time of its last tick."""
    for tick in range(3):
        now_ns += TICK_NS
        _, status = ticked(planner, q, now_ns, seq=tick)
    assert status.mode == PlannerMode.LEADING
    return now_ns
