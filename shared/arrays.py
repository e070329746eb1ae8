"""The type of the laws' arrays: float64 of any shape. Docstrings give shape, unit and frame."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


def vector6(values: Array) -> tuple[float, float, float, float, float, float]:
    """Return an array (6,) as a tuple."""
    a, b, c, d, e, f = values.tolist()
    return a, b, c, d, e, f
