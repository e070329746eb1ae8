"""Loop of the harness service: reads the sensor, tares on request, filters and publishes."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from services.harness.filter import FilterState, WrenchFilter, start_tare, tared_state
from shared.arrays import Array
from shared.bus.messages import Tare, TareRequest, Vector6, Wrench
from shared.bus.ports import Inbox, Outbox
from shared.can.sensor_loop import Sensor, SensorLoop
from shared.robot.stewart import N_LEGS
from shared.rounding import FORCE
from shared.run_directory import live_dir, mapped


class HarnessLoop(SensorLoop[Vector6, Wrench]):
    """Loop that starts with a tare, or with the zero that the previous service stored."""

    def __init__(
        self,
        sensor: Sensor[Vector6],
        law: WrenchFilter,
        publisher: Outbox[Wrench],
        requests: Inbox[TareRequest],
        zero: ZeroFile | None = None,
    ) -> None:
        super().__init__(sensor, publisher)
        self._law, self._requests, self._zero = law, requests, zero
        kept = None if zero is None else zero.read()
        self.state = FilterState() if kept is None else tared_state(kept)
        self._kept = kept is not None

    @property
    def refused(self) -> int:
        """Number of samples that were not finite."""
        return self.state.refused

    def message(self, now_ns: int, sample: Vector6 | None) -> Wrench:
        """Tare on request and filter the leg forces, N; return the wrench in torso axes.

        The sensor is fixed to the torso, so no rotation is needed.
        """
        if self._requests.take() is not None:
            self.state = start_tare(self.state)
        self.state, reading = self._law.step(self.state, now_ns, sample)
        done = self.state.tare is Tare.DONE
        if self._zero is not None and done is not self._kept:
            self._kept = done
            self._zero.write(self.state.offset if done else None)
        fx, fy, fz, mx, my, mz = reading.wrench.round(FORCE).tolist()
        return Wrench(
            t_ns=now_ns,
            seq=self.cycles,
            force=(fx, fy, fz),
            moment=(mx, my, mz),
            valid=reading.valid,
            saturated=reading.saturated,
            tare=int(self.state.tare),
            age_ns=reading.age_ns,
        )


_KEPT: Final = struct.Struct(f"<{N_LEGS}dI")
"""Zero of the leg forces, N, and a checksum over boot id and zero: a kill may interrupt a write."""
_BOOT: Final = Path("/proc/sys/kernel/random/boot_id")


def zero_path(run_dir: Path) -> Path:
    """Return the path of the file with the zero."""
    return live_dir(run_dir) / "harness.zero"


class ZeroFile:
    """File with the latest zero of this fleet's harness, valid until the host restarts."""

    def __init__(self, run_dir: Path, boot: bytes | None = None) -> None:
        """Open or create the file; the directory must exist. `boot` is the id of the host's boot.

        Raises:
            FleetError: the file cannot be created.
        """
        self._memory = mapped(zero_path(run_dir), _KEPT.size)
        self._boot = _BOOT.read_bytes() if boot is None else boot

    def read(self) -> Array | None:
        """Return the stored zero (6,), N; None if the file has no valid zero."""
        *forces, checksum = _KEPT.unpack(self._memory[:])
        offset = np.array(forces)
        return offset if checksum == self._checksum(offset) else None

    def write(self, offset: Array | None) -> None:
        """Store a zero (6,), N; None clears it while a requested tare runs."""
        if offset is None:
            self._memory[:] = bytes(_KEPT.size)
        else:
            self._memory[:] = _KEPT.pack(*offset.tolist(), self._checksum(offset))

    def _checksum(self, offset: Array) -> int:
        return zlib.crc32(self._boot + offset.tobytes())
