"""The sensor's zero in the run directory: a service that restarts does not tare under a load.

A person may rest on the harness when the service crashes. A load that lies still cannot be told
from a zero, so a new tare would take it for one, and the assist would be wrong by it.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Final

import numpy as np

from shared.arrays import Array
from shared.robot.stewart import N_LEGS
from shared.run_directory import mapped

_KEPT: Final = struct.Struct(f"<q{N_LEGS}d")
"""1 if there is a zero, and the leg forces, N."""


def path_of(run_dir: Path) -> Path:
    """Return where the zero is kept until the fleet goes down."""
    return run_dir / "harness.zero"


class ZeroFile:
    """The last zero of this fleet's harness."""

    def __init__(self, run_dir: Path) -> None:
        """Open it, or make it; the directory is there.

        Raises:
            FleetError: it cannot be made.
        """
        self._memory = mapped(path_of(run_dir), _KEPT.size)

    def read(self, force_max: float) -> Array | None:
        """Return the leg forces (6,) that count as zero, N; None: nothing has been tared."""
        there, *forces = _KEPT.unpack(self._memory[:])
        possible = all(math.isfinite(force) and abs(force) <= force_max for force in forces)
        return np.array(forces) if there == 1 and possible else None

    def write(self, offset: Array | None) -> None:
        """Keep a zero (6,), N; None: a tare that was asked for is not done."""
        kept = [0.0] * N_LEGS if offset is None else offset.tolist()
        self._memory[:] = _KEPT.pack(int(offset is not None), *kept)
