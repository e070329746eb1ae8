"""The body's gains, and K_fail against the energy of a robot that springs hold."""

from __future__ import annotations

from itertools import product

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.joint.differential import motor_from_joint
from services.planner.law.certificate import DIRECTIONS, UNITS, Certificate, motor_mean
from services.planner.law.inverse_kinematics import InverseKinematics
from services.planner.law.split import GainLaw, GainSplit
from shared.arrays import Array
from shared.robot.robot_model import stand_pose
from tests.planner.states import ROBOT, Stand, at_pose, closed, p_at, with_law

POSES = (
    {"height": 1.188},
    {"height": 1.0, "x": 0.02, "y": -0.015, "roll": 0.03, "pitch": 0.3, "yaw": 0.04},
    {"height": 0.85, "pitch": 0.6},
    {"height": 0.80, "pitch": 1.2, "yaw": -0.02},
)
ASSISTS = (0.0, 200.0)


@pytest.fixture(
    scope="module", params=product(POSES, ASSISTS), ids=lambda s: f"{s[0]['height']:g}m-{s[1]:g}N"
)
def stand(request: pytest.FixtureRequest) -> Stand:
    pose, assist = request.param
    return Stand(ROBOT, closed(**pose), assist)


@pytest.fixture(scope="module")
def crouched() -> Stand:
    return Stand(ROBOT, closed(1.0, pitch=0.3, x=0.01), 200.0)


def random_stiffness(seed: int) -> Array:
    return np.asarray(np.random.default_rng(seed).uniform(0.0, 2000.0, 12), float)


def smallest(K: Array) -> tuple[float, Array]:
    """Return the smallest mu with K p = mu diag(K_required) p, and p (6,)."""
    values, vectors = np.linalg.eig(K / np.array(ROBOT.certificate.K_required)[:, np.newaxis])
    index = int(values.real.argmin())
    assert abs(values[index].imag) < 1e-6
    return float(values[index].real), np.asarray(vectors[:, index].real, float)


def test_failsafe_stiffness_is_the_curvature_of_the_energy(stand: Stand) -> None:
    D = random_stiffness(1)
    want, got = stand.stiffness_felt(D), stand.certificate.failsafe_stiffness(D)
    np.testing.assert_allclose(got, want, atol=5e-5 * np.abs(want).max())
    np.testing.assert_allclose(got, got.T, rtol=1e-9, atol=1e-6)


def test_of_the_scheduled_gains_it_is_exact_to_1_n_per_m(stand: Stand) -> None:
    """Where the numbers are small and the verdict hangs on them: the smallest eigenvalue."""
    D = stand.split(GainSplit(ROBOT)).D
    felt = stand.stiffness_felt(D)
    np.testing.assert_allclose(stand.certificate.failsafe_stiffness(D), felt, rtol=1e-3, atol=1.0)
    margins = stand.certificate.margins(D)
    assert margins.service == pytest.approx(smallest(felt)[0], abs=2e-3)
    assert margins.service > 0.5


def in_motor_space(D_module: Array, gear_ratio: float) -> Array:
    """Return a module's joint stiffness (2, 2) when each motor springs back on its own.

    Of the stiffness at the motors only the diagonal runs on the drives (docs/drives.md).
    """
    columns = [motor_from_joint((1.0, 0.0), gear_ratio), motor_from_joint((0.0, 1.0), gear_ratio)]
    motors = 2.0 * np.pi * np.array(columns).T  # rad at the motors per rad of the joint
    joints = np.linalg.inv(motors)
    at_motors = joints.T @ np.diag(D_module) @ joints
    k_1, k_2 = D_module
    twice = (2.0 * gear_ratio) ** 2
    assert at_motors[0, 0] == pytest.approx((k_1 + k_2) / twice)  # the design's formula
    return np.asarray(motors.T @ np.diag(np.diagonal(at_motors)) @ motors, float)


def test_onboard_margin_is_of_motors_alone(stand: Stand) -> None:
    D = random_stiffness(4)
    D_onboard = np.zeros(12)
    for module in range(6):
        pair = slice(2 * module, 2 * module + 2)
        K = in_motor_space(D[pair], ROBOT.joint.gear_ratio)
        assert K[0, 1] == pytest.approx(0.0, abs=1e-9)
        D_onboard[pair] = np.diagonal(K)
    np.testing.assert_allclose(motor_mean(D), D_onboard, rtol=1e-12)
    onboard, _ = smallest(stand.stiffness_felt(D_onboard))
    assert stand.certificate.margins(D).onboard == pytest.approx(onboard, rel=1e-3, abs=1e-3)


def test_where_the_chain_has_no_rates_nothing_is_certified() -> None:
    certificate = Certificate(ROBOT)
    certificate.at(np.full((12, 6), np.nan), np.zeros((12, 12)))
    margins = certificate.margins(np.full(12, 1e4))
    assert (margins.service, margins.onboard) == (0.0, 0.0)


def test_a_robot_without_stiffness_falls(stand: Stand) -> None:
    """Held torques do not hold: forward and sideways the weight wins."""
    K = stand.certificate.failsafe_stiffness(np.zeros(12))
    assert K[0, 0] < -500.0
    assert K[1, 1] < -500.0
    assert stand.certificate.margins(np.zeros(12)).service < -0.3


def test_more_assist_leaves_less_margin_in_a_deep_lean() -> None:
    q = closed(0.80, pitch=1.2)
    D = np.full(12, 500.0)
    margins = [Stand(ROBOT, q, assist).certificate.margins(D).onboard for assist in ASSISTS]
    assert margins[1] < margins[0] - 1e-3


@given(
    st.lists(st.floats(0.0, 5000.0), min_size=12, max_size=12),
    st.lists(st.floats(0.0, 2000.0), min_size=12, max_size=12),
)
def test_stiffer_joints_never_lower_a_margin(
    crouched: Stand, D: list[float], more: list[float]
) -> None:
    before = crouched.certificate.margins(np.array(D))
    after = crouched.certificate.margins(np.array(D) + np.array(more))
    assert after.service >= before.service - 1e-9
    assert after.onboard >= before.onboard - 1e-9


def test_all_a_certificate_requires_is_a_margin_of_one(stand: Stand) -> None:
    """Required as much as is there in every direction: 1. Twice as much: a half."""
    K = stand.certificate.failsafe_stiffness(np.full(12, 4000.0))
    least = float(np.linalg.eigvalsh(K)[0])
    for share in (1.0, 2.0):
        required = msgspec.structs.replace(ROBOT.certificate, K_required=(share * least,) * 6)
        certificate = Certificate(msgspec.structs.replace(ROBOT, certificate=required))
        certificate.at(stand.T, stand.hessian_O)
        assert certificate.margins(np.full(12, 4000.0)).service == pytest.approx(1.0 / share)


def test_weakest_is_an_independent_decompositions(stand: Stand) -> None:
    required = np.array(ROBOT.certificate.K_required)
    for D in (stand.split(GainSplit(ROBOT)).D, *(random_stiffness(seed) for seed in range(6, 12))):
        weakest = stand.certificate.weakest(D)
        K = stand.certificate.failsafe_stiffness(D)
        margin, p = smallest(K)
        index = int(np.abs(p * np.sqrt(required)).argmax())
        assert weakest.direction == DIRECTIONS[index]
        assert weakest.unit == UNITS[index]
        assert weakest.required == required[index]
        assert weakest.margin == pytest.approx(margin, rel=1e-6, abs=1e-6)
        assert weakest.stiffness == pytest.approx(margin * required[index], rel=1e-6, abs=1e-3)
        along = weakest.p @ K @ weakest.p / (weakest.p @ (required * weakest.p))
        assert along == pytest.approx(margin, rel=1e-6, abs=1e-6)
        assert weakest.p[index] == pytest.approx(1.0 / np.sqrt(required[index]))


@pytest.mark.parametrize(
    ("soft", "direction"),
    [(slice(0, 12, 2), "lean sideways"), (slice(1, 12, 2), "lean forward")],
    ids=["phi", "theta"],
)
def test_weakest_names_the_way_a_robot_with_soft_joints_falls(soft: slice, direction: str) -> None:
    D = np.full(12, 3000.0)
    D[soft] = 100.0
    weakest = Stand(ROBOT, closed(1.188), 0.0).certificate.weakest(D)
    assert weakest.direction == direction
    assert weakest.margin < 0.0


def test_the_worst_pose_falls_unless_it_is_stiff(ik: InverseKinematics) -> None:
    """The sign changes with the ankles: 0.948 m, ankle theta from limp to stiff."""
    q = at_pose(ROBOT, ik, p_at(ROBOT, 0.948), np.array(stand_pose(ROBOT, 1.188)))
    certificate = Stand(ROBOT, q, 0.0).certificate
    D = np.full(12, 500.0)
    verdicts = []
    for ankle in (0.0, 1000.0):
        D[[1, 7]] = ankle
        verdicts.append(certificate.margins(D).service)
    assert verdicts[0] < 0.0 < verdicts[1]


def test_a_stiffness_that_was_returned_stays_when_another_is_asked_for() -> None:
    certificate, rng = Certificate(ROBOT), np.random.default_rng(3)
    certificate.at(rng.normal(size=(12, 6)), np.zeros((12, 12)))
    soft, stiff = rng.uniform(100.0, 200.0, 12), rng.uniform(1000.0, 2000.0, 12)
    found = certificate.failsafe_stiffness(soft)
    kept = found.copy()
    certificate.margins(stiff)
    np.testing.assert_array_equal(found, kept)
    np.testing.assert_array_equal(certificate.failsafe_stiffness(soft), kept)


# ---- K_q = N K_0 + J^T K_p J - sum_i H_i F_i, B_q = N B_0 + J^T B_p J

OPEN = (2, 4)
"""z and pitch, where the person leads."""


def damped_null_space(J: Array, damping: float) -> Array:
    """Return N = lambda^2 (J^T J + lambda^2 I)^-1 (12, 12)."""
    return np.asarray(np.linalg.inv(J.T @ J / damping**2 + np.eye(12)), float)


@pytest.mark.parametrize("open_K_p", [0.0, 2000.0])
def test_gains_are_symmetric_and_the_papers_sum_without_the_open_directions(
    stand: Stand, open_K_p: float
) -> None:
    """So T^T K_q T + K_geo = S_perp K_p + K_0 T^T N T: the paper's law holds with its own gains."""
    K_p = tuple(open_K_p if i in OPEN else k for i, k in enumerate(ROBOT.law.K_p))
    changed, J, T = with_law(ROBOT, K_p=K_p), stand.kinematics.J, stand.T
    law, gains = changed.law, GainLaw(changed).gains(stand.kinematics, stand.hessian_O)
    closed = 1.0 - np.array(law.S)
    N = damped_null_space(J, law.damping_lambda)
    K_q = law.K_0 * N + J.T @ np.diag(law.K_p * closed) @ J - stand.hessian_O
    B_q = law.B_0 * N + J.T @ np.diag(law.B_p * closed) @ J
    for found, wanted in ((gains.K_q, K_q), (gains.B_q, B_q)):
        np.testing.assert_allclose(found, wanted, atol=1e-9)
        np.testing.assert_array_equal(found, found.T)
    K_geo = stand.certificate.failsafe_stiffness(np.zeros(12))
    assert np.abs(K_geo).max() > 500.0
    along_p = np.diag(law.K_p * closed) + law.K_0 * T.T @ N @ T
    np.testing.assert_allclose(T.T @ gains.K_q @ T + K_geo, along_p, atol=1e-5)
