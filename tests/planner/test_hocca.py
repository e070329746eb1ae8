"""The whole-body law in closed form: statics, open directions, stiffness, references."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from services.planner.law.hocca import Hocca, LawOutput
from services.planner.law.inverse_kinematics import InverseKinematics
from services.planner.law.kinematics import Kinematics
from services.planner.law.split import LocalGains
from shared.config.robot_config import RobotConfig
from tests.planner import oracle
from tests.planner.conftest import Closed, at_pose
from tests.planner.oracle import LEFT, RIGHT, Array

DT = 0.004
STILL = np.zeros(12)
OPEN = {"z": 2, "pitch": 4}

POSES = ((1.25, 0.0), (1.188, 0.0), (0.948, 0.0), (0.85, 0.6), (0.80, 1.2))


@pytest.fixture
def law(robot: RobotConfig) -> Hocca:
    return Hocca(robot)


@pytest.fixture(params=POSES, ids=lambda p: f"{p[0]:g}m-{p[1]:g}rad")
def q(request: pytest.FixtureRequest, closed: Closed) -> Array:
    """Return a centred pose of the squat or the crawl."""
    height, pitch = request.param
    return closed(height, pitch=pitch)


def torque(output: LawOutput, q: Array, v: Array = STILL) -> Array:
    """Return what the joint services apply from a command that is not aged, once it settles."""
    spring = output.local.D * (output.q_ref - q)
    damper = output.local.D_B * (output.v_ref - v)
    return np.asarray(output.tau_ff + output.tau_unfiltered + spring + damper, float)


def gravity(robot: RobotConfig, q: Array) -> Array:
    """Return the slope of the potential energy (12,), N m."""
    energy = oracle.derivative(lambda x: np.array([oracle.potential_energy(robot, x)]), q, 1e-5)
    return np.asarray(energy[0], float)


def moved(robot: RobotConfig, ik: InverseKinematics, q: Array, index: int, by: float) -> Array:
    """Return the joint angles after one part of p has moved and the rest stayed."""
    p = oracle.pose(robot, q)
    p[index] += by
    return at_pose(robot, ik, p, q)


def test_in_balance_feedforward_holds_gravity_along_every_closed_motion(
    robot: RobotConfig, law: Hocca, q: Array
) -> None:
    """Virtual work, to 1e-6 N m: with T (12, 6) of unit columns that keep the legs together."""
    output = law.tick(q, STILL, 0.0, DT)
    C = oracle.derivative(lambda x: oracle.closure(robot, x), q)
    closed_motions = np.linalg.svd(C)[2][6:]
    held, weight = closed_motions @ output.tau_ff, closed_motions @ gravity(robot, q)
    assert np.abs(weight).max() > 10.0
    np.testing.assert_allclose(held, weight, atol=1e-6)


def test_in_balance_nothing_but_feedforward_acts(law: Hocca, q: Array) -> None:
    output = law.tick(q, STILL, 0.0, DT)
    np.testing.assert_allclose(output.q_ref, q, atol=1e-6)
    np.testing.assert_allclose(output.v_ref, 0.0, atol=1e-6)
    np.testing.assert_allclose(output.tau_coupled, 0.0, atol=1e-3)
    np.testing.assert_allclose(torque(output, q), output.tau_ff, atol=1e-3)


@pytest.mark.parametrize("assist", [0.0, 150.0])
def test_feet_carry_the_weight_and_the_assist(
    robot: RobotConfig, law: Hocca, q: Array, assist: float
) -> None:
    output = law.tick(q, STILL, assist, DT)
    feet = [oracle.foot_wrench(robot, side, q, output.tau_ff) for side in (RIGHT, LEFT)]
    expected = 74.58 * oracle.GRAVITY + assist
    assert feet[0][2] + feet[1][2] == pytest.approx(expected, abs=1e-5)
    np.testing.assert_allclose(feet[0][:2] + feet[1][:2], 0.0, atol=1e-5)


def test_assist_acts_at_the_harness_point(robot: RobotConfig, law: Hocca, q: Array) -> None:
    """docs/law.md#feedforward: all of the 150 N, at the harness point and not at the COM."""
    output = law.tick(q, STILL, 150.0, DT)
    total = sum(oracle.torso_wrench(robot, side, q, output.tau_ff) for side in (RIGHT, LEFT))
    leg = oracle.leg(robot, RIGHT, q)
    arm = leg.R @ np.array(robot.geometry.harness_point)
    lift = np.array([0.0, 0.0, 150.0])
    weight = np.array([0.0, 0.0, oracle.masses(robot)[0] * oracle.GRAVITY])
    np.testing.assert_allclose(total, [*(lift + weight), *np.cross(arm, lift)], atol=1e-4)


@pytest.mark.parametrize(("direction", "by"), [("z", -0.01), ("pitch", 0.1)])
def test_open_directions_are_free(
    robot: RobotConfig, law: Hocca, ik: InverseKinematics, q: Array, direction: str, by: float
) -> None:
    """References follow to the tolerance of the IK, and nothing pulls back.

    In the tick of a move, tau_ff may be up to `STEP_SURE` rad behind: under 2 N.
    """
    law.tick(q, STILL, 0.0, DT, align=True)
    q_moved = moved(robot, ik, q, OPEN[direction], by)
    assert np.abs(q_moved - q).max() > 5e-3
    T = oracle.feasible(robot, q_moved)
    weight = gravity(robot, q_moved)
    for force, moment in ((2.0, 0.1), (0.1, 0.01)):
        output = law.tick(q_moved, STILL, 0.0, DT)
        np.testing.assert_allclose(output.q_ref, q_moved, atol=2e-5)
        pull = T.T @ (torque(output, q_moved) - weight)
        assert abs(pull[2]) < force
        assert abs(pull[4]) < moment


def test_a_motion_in_the_open_directions_is_not_damped(
    robot: RobotConfig, law: Hocca, q: Array
) -> None:
    law.tick(q, STILL, 0.0, DT, align=True)
    T = oracle.feasible(robot, q)
    v = T @ np.array([0.0, 0.0, -0.15, 0.0, 0.3, 0.0])
    output = law.tick(q, v, 0.0, DT)
    np.testing.assert_allclose(output.v_ref, v, atol=2e-4)
    pull = T.T @ (torque(output, q, v) - gravity(robot, q))
    assert np.abs(pull[[2, 4]]).max() < 0.1


@pytest.mark.parametrize("index", [0, 1, 3])
def test_a_displacement_in_x_y_or_roll_is_pushed_back_by_k_p_or_more(
    robot: RobotConfig, law: Hocca, ik: InverseKinematics, q: Array, index: int
) -> None:
    """More where the local gains alone are stiffer: the planner softens nothing."""
    law.tick(q, STILL, 0.0, DT, align=True)
    for _ in range(2 * round(robot.law.recentre_s / DT)):
        law._closed_loop_reference(DT)  # the reference has glided to zero
    by = 0.01
    q_moved = moved(robot, ik, q, index, by)
    output = law.tick(q_moved, STILL, 0.0, DT)
    T = oracle.feasible(robot, q_moved)
    pull = T.T @ (torque(output, q_moved) - gravity(robot, q_moved))
    assert pull[index] < -0.94 * robot.law.K_p[index] * by


def test_a_motion_in_x_is_damped_by_its_share_of_b_p(
    robot: RobotConfig, law: Hocca, q: Array
) -> None:
    law.tick(q, STILL, 0.0, DT, align=True)
    T = oracle.feasible(robot, q)
    v = T @ np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    output = law.tick(q, v, 0.0, DT)
    pull = T.T @ (torque(output, q, v) - gravity(robot, q))
    assert robot.gain_schedule is not None
    share = robot.gain_schedule.coupling_damping
    assert pull[0] == pytest.approx(-share * robot.law.B_p[0] * 0.1, rel=0.06)


def test_coupled_torques_come_slowly_and_ease_at_once(
    robot: RobotConfig, law: Hocca, ik: InverseKinematics, q: Array
) -> None:
    law.tick(q, STILL, 0.0, DT, align=True)
    q_moved = moved(robot, ik, q, 1, 0.01)
    first = law.tick(q_moved, STILL, 0.0, DT)
    assert np.abs(first.tau_unfiltered).max() > 1.0
    assert np.abs(first.tau_coupled).max() < 0.05 * np.abs(first.tau_unfiltered).max()
    for _ in range(250):
        output = law.tick(q_moved, STILL, 0.0, DT)
    np.testing.assert_allclose(output.tau_coupled, output.tau_unfiltered, atol=0.02)


def test_align_makes_no_step(law: Hocca, closed: Closed) -> None:
    """Off centre, rolled and yawed: the references are the measured pose."""
    q = closed(1.0, x=0.03, y=-0.02, roll=0.05, pitch=0.3, yaw=-0.04)
    output = law.tick(q, STILL, 0.0, DT, align=True)
    np.testing.assert_allclose(output.q_ref, q, atol=1e-5)
    np.testing.assert_allclose(torque(output, q), output.tau_ff, atol=0.02)


def test_align_makes_no_step_from_any_pose_before(law: Hocca, closed: Closed) -> None:
    law.tick(closed(1.188), STILL, 0.0, DT, align=True)
    q = closed(0.9, x=-0.03, pitch=0.5)
    output = law.tick(q, STILL, 0.0, DT, align=True)
    np.testing.assert_allclose(output.q_ref, q, atol=1e-5)


def test_after_align_the_reference_glides_to_the_centre(
    robot: RobotConfig, law: Hocca, closed: Closed
) -> None:
    q = closed(1.0, x=0.03, y=-0.02, roll=0.05, yaw=-0.04)
    p = oracle.pose(robot, q)
    shut = [0, 1, 3, 5]
    law.tick(q, STILL, 0.0, DT, align=True)
    ticks = round(robot.law.recentre_s / DT)
    before = p[shut]
    for _ in range(ticks):
        p_ref = law.tick(q, STILL, 0.0, DT).p_ref
        step = np.abs(p_ref[shut] - before)
        assert np.all(step <= 2.0 * np.abs(p[shut]) * DT / robot.law.recentre_s)  # min-jerk peak
        assert np.all(np.abs(p_ref[shut]) <= np.abs(before) + 1e-12)
        before = p_ref[shut]
    np.testing.assert_allclose(before, 0.0, atol=1e-9)
    np.testing.assert_allclose(p_ref[[2, 4]], p[[2, 4]], atol=1e-8)  # where the person leads


def test_a_height_and_a_pitch_that_are_closed_stay_where_they_were_found(
    robot: RobotConfig, closed: Closed
) -> None:
    """They glided to a COM on the floor once: zero is no stand."""
    law = msgspec.structs.replace(
        robot.law, S=(0,) * 6, K_p=(2810.0, 2810.0, 3000.0, 800.0, 300.0, 400.0), split="diagonal"
    )
    closing = Hocca(msgspec.structs.replace(robot, law=law))
    q = closed(1.0, x=0.02, pitch=0.3)
    p = oracle.pose(robot, q)
    closing.tick(q, STILL, 0.0, DT, align=True)
    for _ in range(2 * round(robot.law.recentre_s / DT)):
        output = closing.tick(q, STILL, 0.0, DT)
    np.testing.assert_allclose(output.p_ref[[2, 4]], p[[2, 4]], atol=1e-9)
    np.testing.assert_allclose(output.p_ref[[0, 1, 3, 5]], 0.0, atol=1e-9)
    closing.tick(q, STILL, 0.0, DT, align=True)  # and again, after it has led
    np.testing.assert_allclose(closing.tick(q, STILL, 0.0, DT).p_ref[[2, 4]], p[[2, 4]], atol=1e-9)


def test_reference_rates_keep_the_legs_together_and_follow_the_person(
    robot: RobotConfig, law: Hocca, q: Array
) -> None:
    """C v_ref = 0 and J v_ref = S J v, p_C resting."""
    law.tick(q, STILL, 0.0, DT, align=True)
    v = 0.3 * np.random.default_rng(6).normal(size=12)
    output = law.tick(q, v, 0.0, DT)
    kinematics = Kinematics(robot)
    kinematics.update(q)
    S = np.array(robot.law.S)
    pdot = kinematics.J @ v
    assert np.abs(S * pdot).max() > 0.05
    np.testing.assert_allclose(kinematics.C @ output.v_ref, 0.0, atol=1e-4)
    np.testing.assert_allclose(kinematics.J @ output.v_ref, S * pdot, atol=1e-3)


def test_feedforward_rate_is_the_slope_of_feedforward_along_what_the_robot_can_do(
    robot: RobotConfig, ik: InverseKinematics, q: Array
) -> None:
    """Forces between the legs, which D held leaves out, aside."""
    T = oracle.feasible(robot, q)
    pdot = np.array([0.0, 0.0, -0.15, 0.0, 0.3, 0.0])
    law = Hocca(robot)
    law.tick(q, STILL, 0.0, DT, align=True)
    rate = law.tick(q, T @ pdot, 0.0, DT).dtau_ff

    def feedforward(seconds: float) -> Array:
        there = at_pose(robot, ik, oracle.pose(robot, q) + seconds * pdot, q)
        return Hocca(robot).tick(there, STILL, 0.0, DT).tau_ff

    slope = (feedforward(1e-3) - feedforward(-1e-3)) / 2e-3
    assert np.abs(T.T @ slope).max() > 100.0
    np.testing.assert_allclose(T.T @ rate, T.T @ slope, atol=1.0, rtol=0.01)


def test_assist_is_rate_limited_and_capped(robot: RobotConfig, law: Hocca, closed: Closed) -> None:
    q = closed(1.188)
    law.tick(q, STILL, 0.0, DT, align=True)
    before, step = 0.0, robot.assist.rate_max * DT
    for _ in range(round(2 * robot.assist.force_max / step)):
        assist = law.tick(q, STILL, 1e4, DT).assist
        assert 0.0 <= assist - before <= step + 1e-9
        before = assist
    assert before == pytest.approx(robot.assist.force_max)
    for _ in range(round(2 * robot.assist.force_max / step)):
        assist = law.tick(q, STILL, -1e4, DT).assist
        assert -step - 1e-9 <= assist - before <= 0.0
        before = assist
    assert before == 0.0


def test_assist_wanted_at_align_is_within_the_cap(
    robot: RobotConfig, law: Hocca, closed: Closed
) -> None:
    q = closed(1.188)
    assert law.tick(q, STILL, 1e4, DT, align=True).assist == robot.assist.force_max
    assert Hocca(robot).tick(q, STILL, -1e4, DT, align=True).assist == 0.0


def test_assist_is_rate_limited_while_aligning_too(
    robot: RobotConfig, law: Hocca, closed: Closed
) -> None:
    """Only the very first tick takes over at once what HOLD carries."""
    q = closed(1.188)
    assert law.tick(q, STILL, 0.0, DT, align=True).assist == 0.0
    step = robot.assist.rate_max * DT
    assert law.tick(q, STILL, 200.0, DT, align=True).assist == pytest.approx(step)


def test_references_come_back_after_a_lift_past_the_knees_soft_stop(
    robot: RobotConfig, law: Hocca, limits: Array, closed: Closed
) -> None:
    """The soft stop yields: lifted to knees of -0.10 rad (its limit: -0.2) and set down again."""
    stand = closed(1.188)
    beyond = limits + 0.14 * np.array([-1.0, 1.0])  # short of the mechanism's own end, 0.15
    free = InverseKinematics(Kinematics(robot), beyond)
    free.q[:] = stand
    low, high = float(oracle.pose(robot, stand)[2]), 0.92874
    law.tick(stand, STILL, 0.0, DT, align=True)
    furthest = 0.0
    path = [*np.linspace(low, high, 250), *([high] * 250), *np.linspace(high, low, 250)]
    for z in path:
        free.solve(np.array([0.0, 0.0, z, 0.0, 0.0, 0.0]), iterations_max=60)
        q = free.q.copy()
        output = law.tick(q, STILL, 0.0, DT)
        furthest = max(furthest, float(np.abs(output.q_ref - q).max()))
    assert np.abs(q - stand).max() < 1e-4
    assert furthest < 0.3  # the limit itself is 0.1 rad away
    np.testing.assert_allclose(output.q_ref, q, atol=1e-4)


def test_two_laws_given_the_same_give_the_same_bits(robot: RobotConfig, closed: Closed) -> None:
    q = closed(1.0, x=0.01, pitch=0.2)
    v = 0.1 * np.random.default_rng(1).normal(size=12)
    first, second = Hocca(robot), Hocca(robot)
    for _ in range(5):
        one, other = first.tick(q, v, 50.0, DT), second.tick(q, v, 50.0, DT)
        for a, b in zip((*one, *one.local), (*other, *other.local), strict=True):
            if not isinstance(a, LocalGains):  # its parts are compared one by one
                np.testing.assert_array_equal(a, b)
