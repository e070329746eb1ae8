"""Solutions by LAPACK's own routines are NumPy's."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from services.planner.law.small_matrices import LuDecomposition, eigenvalue_min, positive_part


@given(seed=st.integers(0, 10_000), n=st.sampled_from([2, 6, 12]), columns=st.integers(0, 6))
def test_it_solves_as_numpy_does_and_leaves_its_arguments(seed: int, n: int, columns: int) -> None:
    draw = np.random.default_rng(seed)
    A, b = draw.normal(size=(n, n)) + 3.0 * np.eye(n), draw.normal(size=(n, columns or 1))
    b = b if columns else b[:, 0]
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
