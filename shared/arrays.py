"""The type of the laws' arrays: float64 of any shape. Docstrings give shape, unit and frame."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
