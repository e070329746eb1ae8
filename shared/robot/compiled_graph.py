"""A CasADi graph with fixed memory: a call in a loop takes microseconds and allocates nothing.

CasADi interprets a graph. With a C compiler, `python -m tools.graph_libraries` translates the
graphs of a robot into C once (`deploy/lib.sh` calls it), and every process loads the libraries that
it finds. A library is kept only if it gives the same numbers as its graph, to the last bit. Without
libraries everything runs more slowly.
"""

from __future__ import annotations

import functools
import hashlib
import os
import sys
from pathlib import Path
from typing import Final

import casadi as ca
import numpy as np

from shared.arrays import Array

FOLDER: Final = Path(sys.prefix) / "xrl-graphs"
"""Folder of this environment's libraries, one for each graph."""
FLAGS: Final = ("-O2", "-ffp-contract=off", "-fPIC", "-shared")
"""Compiler flags. No fused multiply-add, which rounds differently from CasADi's interpreter; the
functions of CasADi's library are an exception (`tools.graph_libraries.translation`)."""
SWITCH: Final = "XRL_GRAPHS"
"""Environment variable; with the value `interpreted`, every library is ignored."""


class CompiledGraph:
    """A graph with fixed memory for its arguments and results.

    Write `arguments`, call the object, read `results`; all are arrays of the graph's shapes,
    column-major. `translated`: True if C code translated from the graph computes them.
    """

    def __init__(self, function: ca.Function) -> None:
        translated = _translated(function)
        self.translated = translated is not None
        function = translated or function
        buffer, self._call = function.buffer()
        self._buffer = buffer
        self.arguments = [_room(function.size_in(i)) for i in range(function.n_in())]
        self.results = [_room(function.size_out(i)) for i in range(function.n_out())]
        for index, array in enumerate(self.arguments):
            buffer.set_arg(index, array.T.reshape(-1).data)  # type: ignore[call-arg]  # casadi's stub
        for index, array in enumerate(self.results):
            buffer.set_res(index, array.T.reshape(-1).data)  # type: ignore[call-arg]  # casadi's stub

    def bind(self, index: int, array: Array) -> None:
        """Read an argument from a caller's contiguous array (n,), which must outlive this graph."""
        assert array.shape == self.arguments[index].shape  # noqa: S101 - else it reads beyond
        self.arguments[index] = array
        self._buffer.set_arg(index, array.data)  # type: ignore[call-arg]  # casadi's stub

    def __call__(self) -> None:
        """Compute the results from the arguments."""
        self._call()


@functools.lru_cache(maxsize=64)
def library_of(function: ca.Function) -> Path:
    """Return the path of a graph's library, even if it was not built.

    Its name contains a hash of the graph with all constants, CasADi's version and the compiler's
    flags, so another robot or law has another library. The look-up takes milliseconds and is
    cached.
    """
    content = f"{ca.CasadiMeta.version()}\n{FLAGS}\n{function.serialize()}"
    return FOLDER / f"{function.name()}-{hashlib.sha256(content.encode()).hexdigest()[:32]}.so"


def _translated(function: ca.Function) -> ca.Function | None:
    """Return a graph's translation; None if it is missing or cannot be loaded."""
    path = library_of(function)
    if not path.is_file() or os.environ.get(SWITCH) == "interpreted":
        return None
    try:
        return ca.external(function.name(), str(path))
    except RuntimeError:
        return None


def _room(shape: tuple[int, int]) -> Array:
    """Return zeros, column-major; a column is a vector."""
    rows, columns = shape
    return np.zeros(rows) if columns == 1 else np.zeros((rows, columns), order="F")
