"""The stance of the feet and the floor's slope: found, reckoned with, and refused beyond limits."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from services.planner.law.feet import (
    FOLLOW_S,
    SLOPE_MAX,
    Levelling,
    LevellingState,
    Stance,
    StanceState,
    slope_of,
    up_of,
)
from services.planner.law.kinematics import Kinematics, Measured
from shared.arrays import Array
from shared.bus.messages import Pair, Vector3
from shared.config.robot_config import GRAVITY
from tests.imu.robots import with_imu
from tests.planner import oracle
from tests.planner.oracle import LEFT, RIGHT
from tests.planner.states import DT, ROBOT, Kept, Law, closed
from tools.lab.design.torque_breakdown import torque_breakdown

STANCES = (
    (0.1, 0.0, 0.0, 0.0, 0.0, 0.0),
    (0.0, -0.12, 0.02, 0.0, 0.0, 0.0),
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.3),
    (-0.1, 0.12, -0.02, 0.02, -0.03, -0.3),
)
"""The right foot against the left: ahead, wider and on a step, turned in, and all at once."""
LARGEST = (0.12, 0.14, 0.04, 0.06, 0.06, 0.33)


class Standing:
    """Both legs by the paper's equations, their feet put into a stance."""

    def __init__(self, q: Array, stance: Array) -> None:
        self.feet: list[Array] = []
        self.turns: list[Array] = []
        self.knees: list[Array] = []
        self.torsos: list[Array] = []
        self.rotations: list[Array] = []
        for side, half in ((RIGHT, 0.5), (LEFT, -0.5)):
            one = oracle.leg(ROBOT, side, q)
            turn = pin.exp3(half * stance[3:])
            foot = one.ankle + half * stance[:3]
            self.feet.append(foot)
            self.turns.append(turn)
            self.knees.append(foot + turn @ (one.knee - one.ankle))
            self.torsos.append(foot + turn @ (one.torso - one.ankle))
            self.rotations.append(turn @ one.R)

    @property
    def closure(self) -> Array:
        turned = oracle.rotation_vector(self.rotations[LEFT] @ self.rotations[RIGHT].T)
        return np.concatenate((self.torsos[LEFT] - self.torsos[RIGHT], turned))


@pytest.fixture(params=STANCES, ids=("ahead", "wide", "turned", "all"))
def stance(request: pytest.FixtureRequest) -> Array:
    return np.array(request.param)


@pytest.fixture
def standing_there(stance: Array) -> tuple[Kinematics, Array]:
    """Return kinematics in a stance, and joint angles with which both legs agree in it."""
    kinematics, q = Kinematics(ROBOT), closed(1.0, pitch=0.3, yaw=0.04)
    kinematics.stance[:] = stance
    for _ in range(8):
        kinematics.update(q)
        q = q - np.linalg.lstsq(kinematics.C, kinematics.closure, rcond=None)[0]
    kinematics.update(q)
    return kinematics, q


def test_the_stance_found_is_the_one_in_which_the_legs_agree(
    standing_there: tuple[Kinematics, Array], stance: Array
) -> None:
    _, q = standing_there
    np.testing.assert_allclose(Standing(q, stance).closure, 0.0, atol=1e-6)
    np.testing.assert_allclose(Measured(ROBOT).stance_at(q), stance, atol=1e-6)


def test_the_pose_is_the_papers_with_the_feet_where_they_stand(
    standing_there: tuple[Kinematics, Array], stance: Array
) -> None:
    kinematics, q = standing_there
    there = Standing(q, stance)
    m_torso, m_total = oracle.masses(ROBOT)
    weighed = m_torso * there.torsos[RIGHT] + ROBOT.mass.module * sum(there.knees)
    # the ankles weigh too: their middle is the world's origin
    np.testing.assert_allclose(sum(there.feet), 0.0, atol=1e-12)
    np.testing.assert_allclose(kinematics.p[:3], weighed / m_total, atol=1e-6)
    np.testing.assert_allclose(kinematics.p[3:], oracle.euler(there.rotations[RIGHT]), atol=1e-6)


@pytest.mark.parametrize(("matrix", "vector"), [("J", "p"), ("C", "closure")])
def test_jacobians_are_slopes_in_any_stance(
    standing_there: tuple[Kinematics, Array], matrix: str, vector: str
) -> None:
    kinematics, q = standing_there
    got = np.array(getattr(kinematics, matrix))

    def value(near: Array) -> Array:
        kinematics.update(near)
        return np.array(getattr(kinematics, vector))

    np.testing.assert_allclose(got, oracle.derivative(value, q), atol=3e-6)


def test_each_sole_is_asked_for_little_moment_where_it_stands(
    standing_there: tuple[Kinematics, Array], stance: Array
) -> None:
    """The weight over the middle of the feet: no foot is to bear it on a lever of decimetres."""
    kinematics, q = standing_there
    there = Standing(q, stance)
    weight = np.array([0.0, 0.0, 500.0])
    for side, share in ((RIGHT, np.eye(6) - kinematics.D_left), (LEFT, kinematics.D_left)):
        # a weight over the origin, as a wrench at the torso's origin
        torso = there.torsos[side]
        at_torso = share @ np.concatenate((weight, np.cross(-torso, weight)))
        at_foot = at_torso[3:] + np.cross(torso - there.feet[side], at_torso[:3])
        pitch_moment = (there.turns[side].T @ at_foot)[1]
        assert abs(pitch_moment) < 0.01 * 500.0, "less than a centimetre of lever"


def test_feet_astray_make_no_step_at_align() -> None:
    """What the legs disagree by is how the feet stand: it is taken, not fought."""
    q = closed(1.0, pitch=0.3) + 1e-2 * np.random.default_rng(4).normal(size=12)
    output = Law().align(q)
    assert np.abs(oracle.closure(ROBOT, q)).max() > 1e-2
    np.testing.assert_allclose(output.q_ref, q, atol=1e-5)
    np.testing.assert_allclose(output.closure, 0.0, atol=1e-6)


def test_led_it_keeps_the_stance_held_it_follows() -> None:
    """A joint that gives is not a foot that has moved; one that stays moved is."""
    q = closed(1.0, pitch=0.3)
    law = Law()
    began = law.align(q).stance
    moved = q.copy()
    moved[[2, 3]] += 0.01
    for _ in range(20):
        np.testing.assert_array_equal(law.tick(moved).stance, began)
    there = Measured(ROBOT).stance_at(moved).copy()
    away = np.abs(np.subtract(there, began)).max()
    assert away > 5e-3
    for _ in range(round(0.1 / DT)):
        taken = law.align(moved).stance
    assert 0.0 < np.abs(np.subtract(taken, began)).max() < 0.1 * away, "a drop-out of 0.1 s"
    for _ in range(round(4 * FOLLOW_S / DT)):
        taken = law.align(moved).stance
    np.testing.assert_allclose(taken, there, atol=0.05 * away)


@pytest.mark.parametrize("row", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_stance_is_taken_up_to_the_limit_and_refused_beyond_it(row: int, sign: float) -> None:
    held, at_limit = Kept(Stance(LARGEST), StanceState()), np.zeros(6)
    at_limit[row] = sign * LARGEST[row]
    beyond = at_limit.copy()
    beyond[row] = np.nextafter(at_limit[row], sign)
    for measured, refused in ((at_limit, False), (beyond, True), (0.5 * at_limit, False)):
        held.advance(measured)
        assert bool(held.state.refusal) is refused
        assert ("law.stance_max" in held.state.refusal) is refused
        np.testing.assert_array_equal(held.state.taken, at_limit if refused else measured)


def test_what_was_refused_for_long_leaves_no_trace_and_a_moved_foot_is_led_once_followed() -> None:
    held = Kept(Stance(LARGEST), StanceState())
    held.advance(np.zeros(6))
    for _ in range(1000):
        held.advance(np.full(6, 0.5), 0.01)
    assert held.state.refusal
    np.testing.assert_array_equal(held.state.taken, 0.0)
    moved = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.2])
    held.advance(moved, 0.01)
    assert held.state.refusal
    assert "have moved" in held.state.refusal
    for _ in range(400):
        held.advance(moved, 0.01)
    assert not held.state.refusal


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_angles_that_are_no_numbers_are_refused_and_leave_no_trace(number: float) -> None:
    held = Kept(Stance(LARGEST), StanceState())
    good = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.2])
    held.advance(good)
    held.advance(np.full(6, number), 0.1)
    assert held.state.refusal
    np.testing.assert_array_equal(held.state.taken, good)
    assert "no stance" in held.state.refusal
    held.advance(good)
    assert not held.state.refusal


@pytest.mark.parametrize("joint", range(12))
@pytest.mark.parametrize("off", [-np.pi, 3.1, 1.8])
def test_an_encoder_that_is_half_a_turn_off_is_no_stance(joint: int, off: float) -> None:
    q = closed(1.0, pitch=0.3)
    q[joint] += off
    held = Kept(Stance(ROBOT.law.stance_max), StanceState())
    held.advance(Measured(ROBOT).stance_at(q))
    assert held.state.refusal


LEVEL = np.zeros(3)
slopes = st.tuples(*[st.floats(-0.14, 0.14)] * 2)


def told(slope: Pair, angles: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Vector3:
    """Return what an IMU tells on a floor with this slope, the torso so turned on the floor."""
    roll, pitch, yaw = angles
    turned_back = Rotation.from_euler("ZXY", (yaw, roll, pitch)).inv()
    a, b, c = turned_back.apply(up_of(slope)).tolist()
    return a, b, c


@given(slopes, st.tuples(st.floats(-0.3, 0.3), st.floats(-0.5, 1.3), st.floats(-0.3, 0.3)))
def test_the_slope_is_found_however_the_torso_stands(
    slope: tuple[float, float], angles: tuple[float, float, float]
) -> None:
    """By scipy's rotations."""
    assert slope_of(told(slope, angles), *angles) == pytest.approx(slope, abs=1e-12)


@pytest.mark.parametrize(
    "up",
    [
        (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (math.sin(SLOPE_MAX + 0.01), 0.0, 0.9),
        None,
    ],
)  # fmt: skip
def test_what_no_floor_is_like_is_left_out_and_the_last_slope_stands(up: Vector3 | None) -> None:
    """An IMU that has come loose, is upside down, or is silent; with none ever it is level."""
    levelling = Kept(Levelling(1.0), LevellingState())
    levelling.advance(up, LEVEL, DT, jump=True)
    assert levelling.state.slope == (0.0, 0.0)
    levelling.advance(told((0.05, 0.0)), LEVEL, DT, jump=True)
    for _ in range(1000):
        levelling.advance(up, LEVEL, DT, jump=True)
    assert levelling.state.slope == pytest.approx((0.05, 0.0))


def test_the_first_attitude_is_taken_as_it_is_while_the_robot_is_not_led() -> None:
    levelling = Kept(Levelling(1.0), LevellingState())
    levelling.advance(told((0.05, -0.02)), LEVEL, DT, jump=True)
    assert levelling.state.slope == pytest.approx((0.05, -0.02))
    for _ in range(round(1.0 / DT)):
        levelling.advance(told((0.0, 0.0)), LEVEL, DT, jump=True)
    assert levelling.state.slope == pytest.approx((0.05 / math.e, -0.02 / math.e))
    assert up_of(levelling.state.slope) == pytest.approx(up_of(levelling.state.slope))


FLOORS = [(-0.0873, 0.0), (0.05, -0.05)]


@pytest.mark.parametrize("slope", FLOORS)
@pytest.mark.parametrize(("height", "pitch"), [(1.188, 0.0), (0.948, 0.0), (0.85, 0.6)])
def test_on_a_slope_feedforward_holds_the_weight_along_every_closed_motion(
    slope: tuple[float, float], height: float, pitch: float
) -> None:
    """Virtual work against the oracle's COM: the weight pulls along the slope too."""
    law, q = Law(with_imu(ROBOT)), closed(height, pitch=pitch)
    up_torso = told(slope, tuple(oracle.pose(ROBOT, q)[3:]))
    output = law.align(q, up_torso=up_torso)
    assert output.slope == pytest.approx(slope)
    up = np.array(up_of(slope))
    weight = ROBOT.total_mass * GRAVITY
    com = oracle.derivative(lambda angles: oracle.pose(ROBOT, angles)[:3], q, 1e-5)
    C = oracle.derivative(lambda angles: oracle.closure(ROBOT, angles), q)
    closed_motions = np.linalg.svd(C)[2][6:]
    np.testing.assert_allclose(
        closed_motions @ output.tau_ff, closed_motions @ (weight * up @ com), atol=1e-4
    )


def test_a_tick_is_laid_open_with_its_slope() -> None:
    law, q, still = Law(with_imu(ROBOT)), closed(1.0), np.zeros(12)
    output = law.align(q, up_torso=told((0.0873, -0.03)))
    found = torque_breakdown(ROBOT, q, still, output.q_ref, output.v_ref, 0.0, output.slope)
    np.testing.assert_allclose(found.gravity, output.tau_ff, atol=1e-6)


@pytest.mark.parametrize("slope", FLOORS)
def test_the_com_is_led_to_where_gravity_puts_it_over_the_ankles(
    slope: tuple[float, float],
) -> None:
    law, q = Law(with_imu(ROBOT)), closed(1.0)
    up_torso = told(slope)
    first = law.align(q, up_torso=up_torso)
    np.testing.assert_allclose(first.p_ref, first.p, atol=1e-7)
    for _ in range(round(ROBOT.law.recentre_s / DT) + 1):
        output = law.tick(q, up_torso=up_torso)
    x, y, z = up_of(slope)
    lean = np.array((x, y)) / z
    np.testing.assert_allclose(output.p_ref[:2], lean * output.p[2], atol=1e-7)
    assert np.abs(output.p_ref[3:6:2]).max() < 1e-7


def test_an_imu_that_joins_a_led_robot_makes_no_step() -> None:
    """Taken at once, 5 degrees moved the ankles' reference by 0.08 rad in one tick: 125 N m."""
    law, q = Law(with_imu(ROBOT)), closed(1.0)
    law.align(q)
    before = law.tick(q)
    largest = 0.0
    for _ in range(500):
        output = law.tick(q, up_torso=told((0.0873, 0.0)))
        largest = max(largest, float(np.abs(output.q_ref - before.q_ref).max()))
        before = output
    assert output.slope[0] > 0.05
    assert largest < 1e-3
