"""At and near straight knees: the gains, the rates and the IK go through without a jump.

At straight knees no joint rate lifts the torso while the legs stay together: [J; C] is
singular. J alone loses its rank there where the hips are as wide as the feet; the shipped
robot's legs lean by 41 mm each, and J keeps a smallest singular value of 0.019.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import msgspec
import numpy as np
import pytest

from services.planner.law.inverse_kinematics import TOLERANCE
from services.planner.law.kinematics import Kinematics
from services.planner.law.split import GainLaw, GainSplit
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from tests.planner import oracle
from tests.planner.states import LIMITS, ROBOT, WEIGHT, closed, with_law
from tools.reach import ReachSolver

KNEES = [3, 9]
OTHERS = [joint for joint in range(12) if joint not in KNEES]
ASSIST = np.array([0.0, 0.0, 200.0])
STEP = 0.01
"""rad; of the knees along the path."""


class Path(NamedTuple):
    """Configurations from knees of -0.5 rad over 0 to +0.1: level, legs closed."""

    robot: RobotConfig
    q: list[Array]
    J: list[Array]


def path_of(robot: RobotConfig) -> Path:
    """Return the path, closed by the oracle, and what `Kinematics` makes of it."""

    def rows(q: Array) -> Array:
        return np.concatenate([oracle.pose(robot, q)[[0, 1, 3, 4, 5]], oracle.closure(robot, q)])

    kinematics, path = Kinematics(robot), Path(robot, [], [])
    q = np.tile([0.0, 0.1, 0.0, 0.0, 0.0, 0.4], 2)
    for index in range(-50, 11):
        q[KNEES] = index * STEP
        inverse = np.linalg.pinv(oracle.derivative(rows, q)[:, OTHERS], rcond=1e-6)
        for _ in range(40):  # Newton, its slope held
            q[OTHERS] -= inverse @ rows(q)
            if np.abs(rows(q)).max() < 1e-11:
                break
        assert np.abs(rows(q)).max() < 1e-9
        kinematics.update(q)
        path.q.append(q.copy())
        path.J.append(kinematics.J.copy())
    return path


@pytest.fixture(scope="module")
def leaning() -> Path:
    return path_of(ROBOT)


@pytest.fixture(scope="module")
def upright() -> Path:
    """Return the path of a robot whose feet are as wide as its hips."""
    geometry = msgspec.structs.replace(ROBOT.geometry, w_base=ROBOT.geometry.w_hip)
    return path_of(msgspec.structs.replace(ROBOT, geometry=geometry))


@pytest.fixture(params=["leaning", "upright"])
def path(request: pytest.FixtureRequest) -> Path:
    made = request.getfixturevalue(request.param)
    assert isinstance(made, Path)
    return made


def changes(values: list[Array]) -> list[float]:
    """Return how far (2-norm) each value is from the one before it."""
    return [float(np.linalg.norm(b - a, 2)) for a, b in itertools.pairwise(values)]


def test_the_gains_go_through_straight_knees_without_a_jump(path: Path) -> None:
    """No change is more than its slope (per rad of knee) allows; K_q itself is 4400 at most."""
    law, kinematics = GainLaw(path.robot), Kinematics(path.robot)
    gains = []
    for q in path.q:
        kinematics.update(q)
        gains.append(law.gains(kinematics, kinematics.hessian_times(WEIGHT, ASSIST)))
    for values, slope in (([g.K_q for g in gains], 1000.0), ([g.B_q for g in gains], 120.0)):
        assert np.isfinite(values).all()
        assert max(changes(values)) <= slope * STEP


@pytest.mark.parametrize("split", ["certified", "diagonal"])
def test_local_gains_pass_straight_knees_smoothly(leaning: Path, split: str) -> None:
    robot = leaning.robot
    splitting, gain_law = GainSplit(with_law(robot, split=split)), GainLaw(robot)
    ik = ReachSolver(Kinematics(robot), LIMITS)
    local = []
    for q in leaning.q:
        T = per_p(ik, q)
        hessian_F = ik.kinematics.hessian_times(WEIGHT, ASSIST).copy()
        body, p = gain_law.gains(ik.kinematics, hessian_F), ik.kinematics.p
        z, pitch = float(p[2]), float(p[4])
        local.append(splitting.split(lambda body=body: body, z, pitch, T, hessian_F))
    for values, slope in (([x.D for x in local], 4000.0), ([x.D_B for x in local], 400.0)):
        assert np.isfinite(values).all()
        assert np.abs(np.diff(values, axis=0)).max() <= slope * STEP


def per_p(ik: ReachSolver, q: Array) -> Array:
    """Return joint rates per unit of p (12, 6) at q, as the law makes them."""
    ik.q[:] = q
    ik.examine(np.zeros(6))
    return ik.solve_rates(np.eye(12)[:, :6])


def test_rates_are_bounded_whatever_is_asked(path: Path) -> None:
    """By the damping: 1 / (2 * 1e-4) per unit of pdot. Undamped, no number bounds them."""
    ik = ReachSolver(Kinematics(path.robot), LIMITS)
    largest = max(float(np.linalg.norm(per_p(ik, q), 2)) for q in path.q)
    assert largest <= 5000.0
    at_straight = path.q[50]
    per_p(ik, at_straight)
    assert np.linalg.cond(np.vstack([ik.kinematics.J, ik.kinematics.C])) > 1e6


TOP = 0.92693
"""Height of the level COM with both knees at their limit, m, but for 0.01 mm."""


def led(z: float) -> Array:
    return np.array([0.0, 0.0, z, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("beyond", [0.001, 0.1])
def test_led_above_straight_and_back_the_ik_stops_at_the_soft_limit_and_leaves_no_trace(
    ik: ReachSolver, beyond: float
) -> None:
    start = closed(1.188)
    low = float(oracle.pose(ROBOT, start)[2])
    ik.q[:] = start
    for _ in range(3):
        ik.solve(led(low))
    start = ik.q.copy()
    up = np.concatenate([np.linspace(low, TOP, 1000), np.linspace(TOP, TOP + beyond, 200)])
    passed: list[tuple[Array, Array]] = []
    for z in (*up, *up[::-1]):
        before = ik.q.copy()
        ik.solve(led(float(z)))
        assert np.isfinite(ik.q).all()
        assert np.all(ik.q >= LIMITS[:, 0])
        assert np.all(ik.q <= LIMITS[:, 1])
        assert np.abs(ik.q - before).max() < 0.01
        passed.append((ik.q.copy(), oracle.pose(ROBOT, ik.q)))
    assert passed[len(up)][0][KNEES] == pytest.approx(-0.2, abs=1e-12)
    for (q_up, p_up), (q_down, p_down) in zip(passed, passed[::-1], strict=True):
        np.testing.assert_allclose(p_down, p_up, atol=2 * TOLERANCE)
        # the same p to its tolerance; near the limit 1 m of it is up to 80 rad of joints
        np.testing.assert_allclose(q_down, q_up, atol=80.0 * TOLERANCE)
    for _ in range(3):
        ik.solve(led(low))
    np.testing.assert_allclose(ik.q, start, atol=1e-6)
