"""The sensor's zero in the run directory: a service that restarts does not tare under a load.

A person may rest on the harness when the service crashes. A load that lies still cannot be told
from a zero, so a new tare would take it for one, and the assist would be wrong by it. The zero is
of this boot of the host alone, and of the fleet: `xrl down` and the next start remove it.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from shared.arrays import Array
from shared.robot.stewart import N_LEGS
from shared.run_directory import live_dir, mapped

_KEPT: Final = struct.Struct(f"<{N_LEGS}dI")
"""The leg forces, N, and a checksum of this boot and them: a kill may come amid a write."""
_BOOT: Final = Path("/proc/sys/kernel/random/boot_id")


def path_of(run_dir: Path) -> Path:
    """Return where the zero is kept."""
    return live_dir(run_dir) / "harness.zero"


class ZeroFile:
    """The last zero of this fleet's harness."""

    def __init__(self, run_dir: Path, boot: bytes | None = None) -> None:
        """Open it, or make it; the directory is there. `boot` stands for this boot of the host.

        Raises:
            FleetError: it cannot be made.
        """
        self._memory = mapped(path_of(run_dir), _KEPT.size)
        self._boot = _BOOT.read_bytes() if boot is None else boot

    def read(self) -> Array | None:
        """Return the leg forces (6,) that count as zero, N; None: nothing has been tared."""
        *forces, checksum = _KEPT.unpack(self._memory[:])
        offset = np.array(forces)
        return offset if checksum == self._checksum(offset) else None

    def write(self, offset: Array | None) -> None:
        """Keep a zero (6,), N; None: a tare that was asked for is not done."""
        if offset is None:
            self._memory[:] = bytes(_KEPT.size)
        else:
            self._memory[:] = _KEPT.pack(*offset.tolist(), self._checksum(offset))

    def _checksum(self, offset: Array) -> int:
        return zlib.crc32(self._boot + offset.tobytes())
