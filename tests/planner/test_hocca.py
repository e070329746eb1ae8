"""The whole-body law: statics, open directions, stiffness, references; and its own slopes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from services.planner.law import inverse_kinematics, reference
from services.planner.law.hocca import LawOutput
from services.planner.law.inverse_kinematics import TOLERANCE, InverseKinematics
from services.planner.law.kinematics import Kinematics
from services.planner.law.reference import Reference
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.state import copied
from tests.planner import oracle
from tests.planner.oracle import LEFT, RIGHT
from tests.planner.states import DT, LIMITS, ROBOT, STILL, Law, at_pose, closed, with_law

OPEN = {"z": 2, "pitch": 4}
POSES = ((1.25, 0.0), (1.188, 0.0), (0.948, 0.0), (0.85, 0.6), (0.80, 1.2))


@pytest.fixture
def law() -> Law:
    return Law()


@pytest.fixture(params=POSES, ids=lambda p: f"{p[0]:g}m-{p[1]:g}rad")
def q(request: pytest.FixtureRequest) -> Array:
    """Return a centred pose of the squat or the crawl."""
    height, pitch = request.param
    return closed(height, pitch=pitch)


def moved(robot: RobotConfig, ik: InverseKinematics, q: Array, index: int, by: float) -> Array:
    """Return the joint angles after one part of p has moved and the rest stayed."""
    p = oracle.pose(robot, q)
    p[index] += by
    return at_pose(robot, ik, p, q)


@pytest.mark.parametrize(("direction", "by"), [("z", -0.01), ("pitch", 0.1)])
def test_open_directions_are_free(
    law: Law, ik: InverseKinematics, q: Array, direction: str, by: float
) -> None:
    """References follow to the tolerance of the IK, and nothing pulls back.

    In the tick of a move, tau_ff may be up to `STEP_SURE` rad behind: under 2 N.
    """
    law.align(q)
    q_moved = moved(ROBOT, ik, q, OPEN[direction], by)
    assert np.abs(q_moved - q).max() > 5e-3
    T = oracle.feasible(ROBOT, q_moved)
    weight = weight_and_load(q_moved, 0.0)
    for force, moment in ((2.0, 0.1), (0.1, 0.01)):
        output = law.tick(q_moved)
        np.testing.assert_allclose(output.q_ref, q_moved, atol=2e-5)
        pull = T.T @ (torque(output, q_moved) - weight)
        assert abs(pull[2]) < force
        assert abs(pull[4]) < moment


def test_coupled_torques_come_slowly_and_ease_at_once(ik: InverseKinematics, q: Array) -> None:
    law = Law(with_law(ROBOT, push_integral_max=0.0))
    law.align(q)
    q_moved = moved(ROBOT, ik, q, 1, 0.01)
    first = law.tick(q_moved)
    assert np.abs(first.tau_unfiltered).max() > 1.0
    assert np.abs(first.tau_coupled).max() < 0.05 * np.abs(first.tau_unfiltered).max()
    for _ in range(250):
        output = law.tick(q_moved)
    np.testing.assert_allclose(output.tau_coupled, output.tau_unfiltered, atol=0.02)


def test_an_error_that_lasts_is_integrated(law: Law) -> None:
    centred, off = closed(1.0), closed(1.0, y=0.005)
    law.align(centred)
    course = [law.tick(off).tau_coupled for _ in range(500)]
    settled, later = (np.abs(course[at]).max() for at in (150, -1))
    assert later > 1.5 * settled
    held = law.align(centred)
    np.testing.assert_allclose(held.tau_coupled, 0.0, atol=0.1)


def test_align_makes_no_step_from_any_pose_before(law: Law) -> None:
    """Off centre, rolled and yawed: in balance nothing but feedforward acts."""
    off_centre = (
        {"height": 1.0, "x": 0.03, "y": -0.02, "roll": 0.05, "pitch": 0.3, "yaw": -0.04},
        {"height": 0.9, "x": -0.03, "pitch": 0.5},
    )
    centred = [{"height": height, "pitch": pitch} for height, pitch in POSES]
    for number, pose in enumerate((*centred, *off_centre, *centred)):
        q, scale = closed(**pose), 10.0 if pose in off_centre else 1.0
        output = law.tick(q, align=number > 0)
        np.testing.assert_allclose(output.q_ref, q, atol=1e-6 * scale)
        np.testing.assert_allclose(output.v_ref, 0.0, atol=1e-6 * scale)
        np.testing.assert_allclose(output.tau_coupled, 0.0, atol=1e-3 * scale)
        np.testing.assert_allclose(torque(output, q), output.tau_ff, atol=1e-3 * scale)


def test_the_reference_glides_to_the_centre(law: Law) -> None:
    q = closed(1.0, x=0.03, y=-0.02, roll=0.05, yaw=-0.04)
    p = oracle.pose(ROBOT, q)
    shut = [0, 1, 3, 5]
    law.align(q)
    ticks = round(ROBOT.law.recentre_s / DT)
    before = p[shut]
    for _ in range(ticks):
        p_ref = law.tick(q).p_ref
        step = np.abs(p_ref[shut] - before)
        assert np.all(step <= 2.0 * np.abs(p[shut]) * DT / ROBOT.law.recentre_s)  # min-jerk peak
        assert np.all(np.abs(p_ref[shut]) <= np.abs(before) + 1e-12)
        before = p_ref[shut]
    np.testing.assert_allclose(before, 0.0, atol=1e-9)
    np.testing.assert_allclose(p_ref[[2, 4]], p[[2, 4]], atol=1e-8)  # where the person leads


def test_reference_rates_follow_the_person(law: Law, q: Array) -> None:
    """C v_ref = 0 and J v_ref = S J v, p_C resting."""
    law.align(q)
    v = 0.3 * np.random.default_rng(6).normal(size=12)
    output = law.tick(q, v, 0.0, DT)
    kinematics = Kinematics(ROBOT)
    kinematics.update(q)
    S = np.array(ROBOT.law.S)
    pdot = kinematics.J @ v
    assert np.abs(S * pdot).max() > 0.05
    np.testing.assert_allclose(kinematics.C @ output.v_ref, 0.0, atol=1e-4)
    np.testing.assert_allclose(kinematics.J @ output.v_ref, S * pdot, atol=1e-3)


def test_feedforward_rate_is_the_slope_of_feedforward_along_what_the_robot_can_do(
    ik: InverseKinematics, q: Array
) -> None:
    """Forces between the legs, which D held leaves out, aside."""
    T = oracle.feasible(ROBOT, q)
    pdot = np.array([0.0, 0.0, -0.15, 0.0, 0.3, 0.0])
    law = Law()
    law.align(q)
    rate = law.tick(q, T @ pdot, 0.0, DT).dtau_ff

    def feedforward(seconds: float) -> Array:
        there = at_pose(ROBOT, ik, oracle.pose(ROBOT, q) + seconds * pdot, q)
        return Law().tick(there, STILL, 0.0, DT).tau_ff

    slope = (feedforward(1e-3) - feedforward(-1e-3)) / 2e-3
    assert np.abs(T.T @ slope).max() > 100.0
    np.testing.assert_allclose(T.T @ rate, T.T @ slope, atol=1.0, rtol=0.01)


def test_the_first_tick_takes_the_assist_over_and_the_next_ramp_while_aligning_too(
    law: Law,
) -> None:
    q, most = closed(1.188), ROBOT.assist.force_max
    law.align(q)
    ramped = law.align(q, most).assist
    assert ramped == pytest.approx(ROBOT.assist.rate_max * DT)
    assert Law().align(q, 1e4).assist == most


def test_references_come_back_after_a_lift_past_the_knees_soft_stop(law: Law) -> None:
    """The soft stop yields: lifted to knees of -0.10 rad (its limit: -0.2) and set down again."""
    stand = closed(1.188)
    beyond = LIMITS + 0.14 * np.array([-1.0, 1.0])  # short of the mechanism's own end, 0.15
    free = InverseKinematics(Kinematics(ROBOT), beyond)
    free.q[:] = stand
    low, high = float(oracle.pose(ROBOT, stand)[2]), 0.92874
    law.align(stand)
    furthest = 0.0
    path = [*np.linspace(low, high, 250), *([high] * 250), *np.linspace(high, low, 250)]
    for z in path:
        free.solve(np.array([0.0, 0.0, z, 0.0, 0.0, 0.0]), iterations_max=60)
        q = free.q.copy()
        output = law.tick(q)
        furthest = max(furthest, float(np.abs(output.q_ref - q).max()))
    assert np.abs(q - stand).max() < 1e-4
    assert furthest < 0.3  # the limit itself is 0.1 rad away
    np.testing.assert_allclose(output.q_ref, q, atol=1e-4)


# ---- standing still, exactly: what the feet carry, and the law's own slopes

STANDS = (
    {"height": 1.188},
    {"height": 1.0, "x": 0.02, "y": -0.015, "roll": 0.03, "pitch": 0.3, "yaw": 0.04},
    {"height": 0.948},
    {"height": 0.80, "pitch": 1.2},
)
PATHS = (
    *((height, 0.0) for height in np.linspace(1.188, 0.948, 13)),
    *((1.188 - 0.398 * share, 1.2 * share) for share in np.linspace(0.0, 1.0, 13)),
)
"""Torso height, m, and pitch, rad, in the squat and in the crawl (docs/simulator.md)."""


@pytest.fixture(params=STANDS, ids=lambda p: f"{p['height']:g}m-{p.get('pitch', 0):g}rad")
def posed(request: pytest.FixtureRequest) -> Array:
    return closed(**request.param)


def torque(output: LawOutput, q: Array, v: Array = STILL) -> Array:
    """Return what the joint services apply from a command that is not aged."""
    spring = output.local.D * (output.q_ref - q)
    damper = output.local.D_B * (output.v_ref - v)
    return np.asarray(output.tau_ff + output.tau_unfiltered + spring + damper, float)


def settled(law: Law, q: Array, assist: float) -> LawOutput:
    """Return the law's output at rest at a pose, once all of the assist is given."""
    for _ in range(2000):
        if law.align(q, assist).assist == assist:
            return law.align(q, assist, dt=0.0)
    raise AssertionError("the assist never came")


def weight_and_load(q: Array, assist: float) -> Array:
    """Return the slope (12,) of the potential energy of robot and operator's load, N m."""

    def energy(q_near: Array) -> Array:
        load = assist * oracle.harness(ROBOT, q_near)[2]
        return np.array(oracle.potential_energy(ROBOT, q_near) + load)

    return oracle.precise_derivative(energy, q)


def feet(q: Array, tau: Array) -> list[Array]:
    return [oracle.foot_wrench(ROBOT, side, q, tau) for side in (RIGHT, LEFT)]


def about_origin(wrench: Array, at: Array) -> Array:
    """Return a wrench (6,) at a point with its moment about the world's origin."""
    return np.concatenate([wrench[:3], wrench[3:] + np.cross(at, wrench[:3])])


def on_the_feet(q: Array, tau: Array) -> Array:
    """Return the sum (6,) of both feet's wrenches, moment about the world's origin."""
    ankles = [oracle.leg(ROBOT, side, q).ankle for side in (RIGHT, LEFT)]
    right, left = feet(q, tau)
    return about_origin(right, ankles[0]) + about_origin(left, ankles[1])


def to_carry(q: Array, assist: float) -> Array:
    """Return the wrench (6,) that weight and operator's load ask of the floor."""
    weight = np.array([0.0, 0.0, oracle.masses(ROBOT)[1] * oracle.GRAVITY, 0.0, 0.0, 0.0])
    lift = np.array([0.0, 0.0, assist, 0.0, 0.0, 0.0])
    r_com, r_harness = oracle.pose(ROBOT, q)[:3], oracle.harness(ROBOT, q)
    return about_origin(weight, r_com) + about_origin(lift, r_harness)


@pytest.mark.parametrize("assist", [0.0, 200.0])
def test_feedforward_is_exact_at_rest_and_the_feet_carry_weight_and_assist(
    posed: Array, assist: float
) -> None:
    """T^T tau_ff = d(energy)/dp to 1e-9 N and N m, at the pose that the law itself takes.

    All six parts of the feet's sum, about the world's origin.
    """
    output = settled(Law(), posed, assist)
    np.testing.assert_allclose(output.q_ref, posed, atol=1e-6)
    T = oracle.feasible(ROBOT, posed)
    held, wanted = T.T @ output.tau_ff, T.T @ weight_and_load(posed, assist)
    assert wanted[2] > 74.0 * oracle.GRAVITY + assist
    np.testing.assert_allclose(held, wanted, atol=1e-9)
    got = on_the_feet(posed, torque(output, posed))
    np.testing.assert_allclose(got, to_carry(posed, assist), atol=1e-5)


@pytest.mark.parametrize("assist", [0.0, 200.0])
def test_each_centre_of_pressure_stays_inside_its_sole(law: Law, assist: float) -> None:
    """Over the whole squat and the whole crawl; and no foot slides."""
    geometry = ROBOT.geometry
    for height, pitch in PATHS:
        q = closed(height, pitch=pitch)
        for wrench in feet(q, torque(settled(law, q, assist), q)):
            force = wrench[:3]
            below = np.array([0.0, 0.0, -geometry.foot_height])
            moment = wrench[3:] - np.cross(below, force)
            x, y = -moment[1] / force[2], moment[0] / force[2]
            room = (geometry.l_foot / 2 - abs(x), geometry.w_foot / 2 - abs(y))
            assert min(room) > 0.01, (height, pitch, assist, x, y)
            assert force[2] > 0.3 * oracle.masses(ROBOT)[1] * oracle.GRAVITY
            assert np.hypot(force[0], force[1]) < 0.5 * force[2]  # rubber on a poor floor


def K_p(robot: RobotConfig) -> Array:  # noqa: N802 - the paper's letter
    return np.diag(np.array(robot.law.K_p) * (1.0 - np.array(robot.law.S)))


@pytest.fixture
def exact_ik(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the inverse kinematics go on until nothing is left to do."""
    monkeypatch.setattr(inverse_kinematics, "TOLERANCE", 1e-13)
    for module in (inverse_kinematics, reference):
        monkeypatch.setattr(module, "STEP_SURE", 1e-9)


def torque_of(law: Law) -> Callable[[Array, Array], Array]:
    """Return (q, v) -> total torque (12,) of a tick at standing time, nothing remembered."""

    def total(q: Array, v: Array) -> Array:
        return torque(law.tick(q, v, 0.0, 0.0), q, v)

    return total


@pytest.mark.usefixtures("exact_ik")
def test_it_feels_like_k_p_where_it_balances_or_free(posed: Array) -> None:
    """With the real S, references moving: -dQ/dp = (K_fail + K_c) S_perp, Q all forces."""
    law = Law()
    law.align(posed, dt=0.0)
    total, q_of = torque_of(law), oracle.closed_chain(ROBOT, posed)

    def felt(p: Array) -> Array:
        q_near = q_of(p)
        out_of_balance = total(q_near, STILL) - weight_and_load(q_near, 0.0)
        return np.asarray(oracle.feasible(ROBOT, q_near).T @ out_of_balance, float)

    slope = oracle.derivative(felt, oracle.pose(ROBOT, posed), 1e-4)
    S_perp = np.diag(1.0 - np.array(ROBOT.law.S))
    at_ref = law.tick(posed, STILL, 0.0, 0.0)
    T, D = oracle.feasible(ROBOT, posed), at_ref.local.D
    # T_ref has them at the law's own damping of its inverse
    K_fail = law.hocca.split.certificate.failsafe_stiffness(D)
    K_c, _ = law.hocca._terms._uncoupled.at(K_fail, (T.T * at_ref.local.D_B) @ T)
    wanted = (K_fail + K_c) @ S_perp
    np.testing.assert_allclose(-slope, wanted, rtol=2e-3, atol=3.0)
    closed = np.flatnonzero(np.diag(S_perp))
    left = -slope[np.ix_(closed, closed)] - K_p(ROBOT)[np.ix_(closed, closed)]
    assert np.linalg.eigvalsh(0.5 * (left + left.T)).min() > -3.0


@pytest.mark.usefixtures("exact_ik")
def test_motion_is_damped_where_it_balances_or_free(posed: Array) -> None:
    law = Law()
    law.align(posed, dt=0.0)
    total, T = torque_of(law), oracle.feasible(ROBOT, posed)
    slope = oracle.derivative(lambda pdot: T.T @ total(posed, T @ pdot), np.zeros(6), 1e-4)
    S_perp = np.diag(1.0 - np.array(ROBOT.law.S))
    local = law.tick(posed, STILL, 0.0, 0.0).local
    B_local = (T.T * local.D_B) @ T
    _, B_c = law.hocca._terms._uncoupled.at(
        law.hocca.split.certificate.failsafe_stiffness(local.D), B_local
    )
    wanted = (B_local + B_c) @ S_perp
    np.testing.assert_allclose(-slope, wanted, rtol=2e-3, atol=0.5)


NOWHERE = np.tile([-4.0, 4.0], (12, 1))
"""Joint limits that stop nothing."""


def solved(reference: Reference, q: Array, p_ref: Array) -> int:
    """Solve for p_ref from q, at rest; return the iterations."""
    at_start = Kinematics(ROBOT)
    at_start.update(q)
    reference.load(np.zeros(6), np.zeros(6), np.zeros(3), np.zeros(3), at_start.D_left)
    return reference.solve(q, p_ref).iterations


@pytest.mark.parametrize("away", [1e-5, 2e-4, 0.02, 0.05])
def test_it_finds_what_the_solver_does(away: float) -> None:
    q = closed(1.0, pitch=0.3)
    there = Kinematics(ROBOT)
    there.update(q)
    p_ref = there.p + away * np.array([0.1, -0.1, 1.0, 0.0, 0.5, 0.0])
    reference = Reference(ROBOT)
    iterations = solved(reference, q, p_ref)
    there.update(reference.q)
    assert np.abs(there.p - p_ref).max() < 2.0 * TOLERANCE
    assert np.abs(there.closure).max() < 2.0 * TOLERANCE
    assert (iterations == 1) == (away < 1e-4)


@pytest.mark.parametrize("rate", [0.02, 0.6])
def test_led_beyond_it_stays_inside(rate: float) -> None:
    """The solver takes a start for granted; one beyond the limits let q_ref creep to 0.17 rad."""
    limits = np.array(ROBOT.joint_limits())
    law, ik = Law(), InverseKinematics(Kinematics(ROBOT), NOWHERE)
    height = 0.923  # of the COM: 4 mm below where the knees come to their limit
    ik.q[:] = closed(1.15)
    p = np.array([0.0, 0.0, height, 0.0, 0.0, 0.0])
    assert ik.solve(p, iterations_max=50).converged
    q = ik.q.copy()
    law.align(q)
    beyond = 0.0
    while p[2] < height + 0.01:
        p[2] += rate * DT
        ik.solve(p, iterations_max=50)
        v, q = (ik.q - q) / DT, ik.q.copy()
        q_ref = law.tick(q, v, 0.0, DT).q_ref
        beyond = max(beyond, float(np.maximum(limits[:, 0] - q_ref, q_ref - limits[:, 1]).max()))
    assert np.maximum(limits[:, 0] - q, q - limits[:, 1]).max() > 0.03, "it was led beyond"
    assert beyond < 1e-9


@pytest.mark.parametrize("rate", [-50.0, 50.0])
def test_the_next_begins_inside(rate: float) -> None:
    reference = Reference(ROBOT)
    solved(reference, closed(1.0), np.zeros(6))
    reference.v[:] = rate
    low, high = np.array(ROBOT.joint_limits()).T
    np.testing.assert_array_equal(reference.expected(1.0), low if rate < 0.0 else high)


def test_of_nan_nothing_is_found_but_the_next_is() -> None:
    q = closed(1.0)
    there = Kinematics(ROBOT)
    there.update(q)
    reference = Reference(ROBOT)
    p_ref = there.p.copy()
    p_ref[1] = np.nan
    reference.load(np.full(6, np.nan), np.zeros(6), np.zeros(3), np.zeros(3), there.D_left)
    assert not reference.solve(q, p_ref).converged
    start = reference.expected(DT)
    assert np.isfinite(start).all()
    reference.load(np.zeros(6), np.zeros(6), np.zeros(3), np.zeros(3), there.D_left)
    assert reference.solve(start, there.p).converged
    np.testing.assert_allclose(reference.q, q, atol=1e-6)


def test_a_law_that_is_continued_closes_height_and_pitch_as_the_one_before_it() -> None:
    """How far the height's reference may lead follows from the last tick's joint rates."""
    law, twin, q, v = Law(), Law(), closed(1.25), np.full(12, 0.1)
    law.align(q)
    law.tick(q, v)
    twin.state = copied(law.state)
    assert twin.state.height.T_z == np.abs(law.hocca.reference.T[:, 2]).max() > 5.0
    for _ in range(3):
        one, other = (each.tick(q, v, released=(True, True)) for each in (law, twin))
        np.testing.assert_array_equal(one.tau_ff, other.tau_ff)
        np.testing.assert_array_equal(one.q_ref, other.q_ref)
