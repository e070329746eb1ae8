"""The coupled torque: it only adds, only where the person does not lead, and slowly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.planner.law.coupling import (
    FAST,
    CouplingState,
    PushIntegral,
    UncoupledGains,
    low_passed,
    pole_gain,
)
from services.planner.law.small_matrices import LuDecomposition, eigenvalue_min, positive_part
from tests.planner.states import DT, ROBOT, with_law

K_P = np.array([2810.0, 2810.0, 0.0, 800.0, 0.0, 400.0])
B_P = np.array([300.0, 300.0, 0.0, 60.0, 0.0, 40.0])
S = np.array([0.0, 0.0, 1.0, 0.0, 1.0, 0.0])
CLOSED = np.ix_([0, 1, 3, 5], [0, 1, 3, 5])


def symmetric(seed: int, scale: float) -> np.ndarray:
    A = np.random.default_rng(seed).normal(size=(6, 6))
    return scale * 0.5 * (A + A.T)


def missing(damping: float = 1.0) -> UncoupledGains:
    return UncoupledGains(K_P, B_P, S, damping)


def test_what_is_missing_fills_up_to_the_body_s_gains() -> None:
    K_fail, B_local = np.diag([1200.0, 800.0, 500.0, 300.0, 30.0, 150.0]), 100.0 * np.eye(6)
    K_c, B_c = missing(2.0).at(K_fail, B_local)
    np.testing.assert_allclose(np.diag(K_c), [1610.0, 2010.0, 0.0, 500.0, 0.0, 250.0], rtol=1e-9)
    np.testing.assert_allclose(np.diag(B_c), [500.0, 500.0, 0.0, 20.0, 0.0, 0.0], atol=1e-9)


def test_gains_that_are_stiffer_than_the_body_s_are_not_softened() -> None:
    K_c, B_c = missing().at(np.diag([5000.0] * 6), np.diag([1000.0] * 6))
    np.testing.assert_allclose(K_c, 0.0, atol=1e-9)
    np.testing.assert_allclose(B_c, 0.0, atol=1e-9)


@given(st.integers(0, 10_000), st.floats(1.0, 1e5), st.floats(0.0, 4.0))
def test_it_only_adds_and_only_where_closed(seed: int, scale: float, damping: float) -> None:
    for matrix in missing(damping).at(symmetric(seed, scale), symmetric(seed + 1, scale)):
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9, atol=1e-9 * scale)
        assert np.linalg.eigvalsh(matrix).min() > -1e-8 * max(scale, 1e4)
        assert not matrix[[2, 4]].any()
        assert not matrix[:, [2, 4]].any()


@given(st.integers(0, 10_000), st.floats(1.0, 1e4))
def test_with_it_the_closed_rows_are_as_stiff_as_asked(seed: int, scale: float) -> None:
    K_fail = symmetric(seed, scale)
    K_c, _ = missing().at(K_fail, np.zeros((6, 6)))
    left = (K_fail + K_c)[CLOSED] - np.diag(K_P[[0, 1, 3, 5]])
    assert np.linalg.eigvalsh(left).min() > -1e-6 * max(scale, 1e4)


def test_a_pole_follows_its_bandwidth() -> None:
    """1 - exp(-2 pi f dt): after the time constant 63 % of a step."""
    assert pole_gain(2.0, 1.0 / (2.0 * np.pi * 2.0)) == pytest.approx(1.0 - np.exp(-1.0))
    assert pole_gain(0.0, 1.0) == 0.0


def filtered(s: CouplingState, tau: float, bandwidth_hz: float, dt: float = DT) -> float:
    return float(low_passed(s, np.full(12, tau), bandwidth_hz, dt)[0])


def test_a_step_comes_through_two_poles_and_all_of_it() -> None:
    s, share = CouplingState(), pole_gain(4.0, DT)
    course = [filtered(s, 1.0, 4.0) for _ in range(250)]
    assert course[0] == share * share
    assert (np.diff(course) > 0.0).all()
    np.testing.assert_allclose(course[-1], 1.0, atol=1e-6)


def test_above_its_bandwidth_it_falls_with_the_square() -> None:
    gains = []
    for hz in (20.0, 40.0):
        s = CouplingState()
        t = np.arange(2000) * 1e-3
        out = [filtered(s, np.sin(2 * np.pi * hz * at), 2.0, 1e-3) for at in t]
        gains.append(np.abs(out[1000:]).max())
    assert 3.5 < gains[0] / gains[1] < 4.5


# ---- its integral


def integral_of(**law: object) -> PushIntegral:
    return PushIntegral(with_law(ROBOT, **law).law)


def test_in_its_time_the_integral_grows_to_what_the_body_s_stiffness_gives() -> None:
    integral, force = integral_of(push_integral_s=2.0), 0.0
    for _ in range(500):
        force = integral.after(force, 0.01, 0.0, DT)
    assert force == pytest.approx(ROBOT.law.K_p[1] * 0.01)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_at_its_limit_the_integral_stays_and_comes_back_at_once(sign: float) -> None:
    integral = integral_of(push_integral_max=40.0)
    assert integral.after(39.9 * sign, sign, 0.0, DT) == sign * 40.0
    assert abs(integral.after(40.0 * sign, -sign * 1e-3, 0.0, DT)) < 40.0


@pytest.mark.parametrize(
    ("rate", "share"), [(0.0, 1.0), (0.5, 0.5), (-0.5, 0.5), (1.0, 0.0), (-2.0, 0.0)]
)
def test_the_faster_an_error_changes_the_less_of_it_is_integrated(
    rate: float, share: float
) -> None:
    integral = integral_of(push_integral_s=2.0)
    force = integral.after(0.0, 0.01, rate * FAST, DT)
    assert force == pytest.approx(share * 0.002 * ROBOT.law.K_p[1] * 0.01)


@pytest.mark.parametrize(
    "law", [{"S": (0, 1, 1, 0, 1, 0)}, {"split": "diagonal"}, {"push_integral_max": 0.0}]
)
def test_it_integrates_nothing_that_is_led_the_papers_or_without_a_limit(
    law: dict[str, object],
) -> None:
    integral = integral_of(**law)
    assert integral.after(0.0, 0.01, 0.0, DT) == integral.most == 0.0
    assert (integral.gain == 0.0) is ("push_integral_max" not in law), "what the certificate takes"


# ---- the matrices that it solves


@given(seed=st.integers(0, 10_000), n=st.sampled_from([2, 6, 12]))
def test_it_solves_as_numpy_does_and_leaves_its_arguments(seed: int, n: int) -> None:
    draw = np.random.default_rng(seed)
    A, b = draw.normal(size=(n, n)) + 3.0 * np.eye(n), draw.normal(size=n)
    A_before, b_before = A.copy(), b.copy()
    decomposition = LuDecomposition(A)
    np.testing.assert_allclose(decomposition.solve(b), np.linalg.solve(A, b), atol=1e-9)
    assert np.array_equal(A, A_before)
    assert np.array_equal(b, b_before)


def test_of_what_is_no_number_nothing_is_solved() -> None:
    assert np.isnan(LuDecomposition(np.full((3, 3), np.nan)).solve(np.ones(3))).all()


@given(seed=st.integers(0, 10_000), n=st.sampled_from([2, 4, 6]))
def test_eigenvalues_and_positive_parts_are_numpys(seed: int, n: int) -> None:
    draw = np.random.default_rng(seed)
    A = draw.normal(size=(n, n))
    A = A + A.T
    before = A.copy()
    values, vectors = np.linalg.eigh(A)
    np.testing.assert_allclose(eigenvalue_min(A), values[0], atol=1e-9)
    wanted = (vectors * np.maximum(values, 0.0)) @ vectors.T
    np.testing.assert_allclose(positive_part(A), wanted, atol=1e-9)
    assert np.array_equal(A, before)
