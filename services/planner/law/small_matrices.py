"""Decompositions of small matrices by LAPACK, without NumPy's checks around each call. Pure.

`np.linalg.solve` of a 12 x 12 system spends more time on types, shapes and error states than on the
system: 13 us, where LAPACK's own routine takes 4.4. Eigenvalues of a 6 x 6 matrix take a third of
NumPy's time.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack

from shared.arrays import Array


class LuDecomposition:
    """P L U of a square matrix: factored once, solved as often as wanted."""

    __slots__ = ("_lu", "_pivots")

    def __init__(self, A: Array) -> None:
        """Factor A (n, n), which is not changed. Of a singular one nothing can be solved."""
        self._lu, self._pivots, _ = lapack.dgetrf(A)

    def solve(self, b: Array) -> Array:
        """Return x of A x = b, for b (n,) or (n, m)."""
        x: Array = lapack.dgetrs(self._lu, self._pivots, b)[0]
        return x


def eigenvalue_min(A: Array) -> float:
    """Return the smallest eigenvalue of a symmetric A (n, n), all of whose numbers are finite."""
    return float(lapack.dsyevd(A, compute_v=0)[0][0])


def positive_part(A: Array) -> Array:
    """Return a symmetric A (n, n) with each negative eigenvalue replaced by 0.

    All numbers of A must be finite.
    """
    values, vectors, _ = lapack.dsyevd(A)
    positive: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return positive
