"""The laws' arrays: float64 of any shape. Docstrings give shape, unit and frame."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


def vector6(values: Array) -> tuple[float, float, float, float, float, float]:
    """Return an array (6,) as a tuple."""
    a, b, c, d, e, f = values.tolist()
    return a, b, c, d, e, f


def rounded_rows(vectors: Sequence[Array], decimals: tuple[int, ...]) -> Array:
    """Return vectors of one length as the rows of an array, each rounded to its decimals."""
    rows: Array = np.concatenate(vectors).reshape(len(vectors), -1)
    per_unit = _per_unit(decimals)
    return np.divide(np.rint(np.multiply(rows, per_unit, rows), rows), per_unit, rows)


@cache
def _per_unit(decimals: tuple[int, ...]) -> Array:
    return np.array([[10.0**count] for count in decimals])
