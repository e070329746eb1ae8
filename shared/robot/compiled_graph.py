"""A CasADi graph with fixed memory: a call in a loop costs microseconds and allocates nothing."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class CompiledGraph:
    """A graph with fixed memory for its arguments and results.

    `arguments` are written, the object is called, `results` are read; all are arrays of
    the graph's shapes, column-major.
    """

    def __init__(self, function: ca.Function) -> None:
        """Take the graph."""
        buffer, self._call = function.buffer()
        self._buffer = buffer
        self.arguments = [_room(function.size_in(i)) for i in range(function.n_in())]
        self.results = [_room(function.size_out(i)) for i in range(function.n_out())]
        for index, array in enumerate(self.arguments):
            buffer.set_arg(index, memoryview(array.T.reshape(-1)))  # type: ignore[call-arg, arg-type]  # casadi's stub
        for index, array in enumerate(self.results):
            buffer.set_res(index, memoryview(array.T.reshape(-1)))  # type: ignore[call-arg, arg-type]  # casadi's stub

    def __call__(self) -> None:
        """Compute the results from the arguments."""
        self._call()


def _room(shape: tuple[int, int]) -> Array:
    """Return zeros, column-major; a column is a vector."""
    rows, columns = shape
    return np.zeros(rows) if columns == 1 else np.zeros((rows, columns), order="F")
