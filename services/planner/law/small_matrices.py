"""Decompositions of small matrices by Eigen, without NumPy's checks around each call. Pure.

`np.linalg.solve` of a 12 x 12 system spends most of its 12 us on types, shapes and error states;
Eigen takes 5 us. Eigenvalues of a 6 x 6 matrix take half of NumPy's time. Pinocchio includes
Eigen's Python bindings. SciPy's LAPACK is as fast, but its import takes 0.37 s, a third of the
computing time before a restarted planner leads.
"""

from __future__ import annotations

import eigenpy
import numpy as np

from shared.arrays import Array


class LuDecomposition:
    """LU decomposition of a square matrix, with pivoting; factored once for many solves."""

    __slots__ = ("_lu",)

    def __init__(self, A: Array) -> None:
        """Factor A (n, n), which stays unchanged and must not be singular."""
        self._lu = eigenpy.PartialPivLU(A)

    def solve(self, b: Array) -> Array:
        """Return x that solves A x = b, for b (n,)."""
        x: Array = self._lu.solve(b)
        return x


def eigenvalue_min(A: Array) -> float:
    """Return the smallest eigenvalue of a symmetric, finite A (n, n)."""
    return float(eigenpy.SelfAdjointEigenSolver(A).eigenvalues()[0])


def positive_part(A: Array) -> Array:
    """Return a symmetric A (n, n) with each negative eigenvalue replaced by 0.

    All elements of A must be finite.
    """
    solver = eigenpy.SelfAdjointEigenSolver(A)
    values, vectors = solver.eigenvalues(), solver.eigenvectors()
    positive: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return positive
