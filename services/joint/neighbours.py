"""Shared memory between the six joint services of one host, without a bus.

After an emergency stop the knees sink, and each module must react to the others:

- If the ankles only held, the COM would move back as the knees fold: from nearly straight legs
  (1.28 m) the robot fell over backwards. So an ankle uses its knee's angle to keep the hip joint in
  place.
- If the hips only damped, the thighs would drag the torso back by 1.5 rad; with its COM 5 cm back
  and 10 cm up, the robot fell over. So a hip uses its ankle's and knee's angles to hold the torso's
  attitude.
- A knee that sinks beside a knee whose service is dead tips the robot sideways: the robot fell
  within 4 s. With knees sinking beside an ankle or hip whose drive kept holding, it fell in 28 of
  40 stops. So a knee stops sinking if another module stays up.

If a knee or ankle is limp, others stiffen, in HOLD and in DAMP (`shared.robot.hold_rules`). Without
that, the robot fell within 1.3 s after a knee went limp with the planner dead, and within 2 s after
an emergency stop with a limp knee. A drive that loses power only falls silent. When the others
stiffened only after 100 ms, at DRIVE_LOST, the robot fell in 3 of 4 squats.

All this must work without planner and bus. So in each cycle each service stores its row in a file
that all six have mapped, which the control path may do. Modules on another host are unknown: hips
then damp, knees sink, and only a planner makes modules stiffen.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple
from zlib import crc32

from shared.bus.messages import Mode, Pair
from shared.clock import NS_PER_MS, NS_PER_S
from shared.config.sections import LOST_S
from shared.joints import MODULE_INDEX, MODULES, N_MODULES, kind_of
from shared.robot.hold_rules import SUPPORT_FOR
from shared.rounding import POSITION, rounded
from shared.run_directory import live_dir, mapped

STALE_NS: Final = 20 * NS_PER_MS
"""Maximum age of a neighbour's angle, ns."""
SILENT_NS: Final = 40 * NS_PER_MS
"""Silence after which a drive may be limp, ns: shorter than the age limit and the silence after
which a drive is lost."""
GONE_NS: Final = round(LOST_S * NS_PER_S)
"""Age of a row above which its service is dead or its drive is lost, ns."""
_LEG: Final = N_MODULES // 2
"""Offset from a module to the same module of the other leg."""
_SUM: Final = struct.Struct("<Q")
_BODY: Final = struct.Struct("<QddQQQ")
_ROW: Final = struct.Struct("<QQddQQQ")
"""Checksum of a `NeighbourRow`, then the row. A sequence lock would need stores to become visible
in order, which Arm does not guarantee."""
READS: Final = 5
"""Maximum number of attempts to read a whole row; its writer may have died while writing."""
_SIZE: Final = N_MODULES * _ROW.size


class NeighbourRow(NamedTuple):
    """State of one module, as its service wrote it."""

    t_ns: int
    """Time of the drive's newest accepted sample, ns; 0 before the first."""
    theta: float
    """rad"""
    rate: float
    """rad/s"""
    mode: int
    """`Mode`."""
    caught: int = 0
    """1 in DAMP if it does not sink: a caught knee, or a module that has stiffened."""
    silent: int = 0
    """1 if the module is not DISARMED and its drive has been silent for `SILENT_NS`."""


class NeighbourView(NamedTuple):
    """A module's view of its neighbours."""

    leg: Pair | None = None
    """Theta and rate, rad, rad/s: for a hip the sum of its ankle's and knee's, for an ankle its
    knee's; None if unknown."""
    sinks: bool = True
    """For a knee: False if another module stays up, because sinking would then tip the robot."""
    stiffen: bool = False
    """True if this module must stiffen because another one is limp."""


UNKNOWN: Final = NeighbourView()


def path_of(run_dir: Path) -> Path:
    """Return the path of the shared file."""
    return live_dir(run_dir) / "joints.near"


def view_of(module: str, rows: Sequence[NeighbourRow | None], now_ns: int) -> NeighbourView:
    """Return a module's view of the rows.

    Args:
        module: name of the viewing module.
        rows: the six rows; None for a row that is being written or was never written.
        now_ns: the host's monotonic clock.
    """
    kind, own = kind_of(module), MODULE_INDEX[module]
    heard = _fresh(rows[own], now_ns) is not None  # otherwise all services may have been paused
    limp = [
        wanted
        for row, wanted in zip(rows, SUPPORT_FOR, strict=True)
        if row is not None and row.t_ns > 0 and (row.mode == Mode.FAULT or (heard and row.silent))
    ]
    stiffen = bool(limp) and max(limp).includes(module)
    leg: Pair | None = None
    sinks = True
    if kind == "hip":
        ankle, knee = _fresh(rows[own - 2], now_ns), _fresh(rows[own - 1], now_ns)
        if ankle is not None and knee is not None:
            leg = rounded((ankle.theta + knee.theta, ankle.rate + knee.rate), POSITION)
    elif kind == "ankle":
        knee = _fresh(rows[own + 1], now_ns)
        if knee is not None:
            leg = (knee.theta, knee.rate)
    else:
        other = rows[(own + _LEG) % N_MODULES]
        if other is not None and not _is_elsewhere(other, now_ns):  # stopping alone tips the robot
            others = (row for at, row in enumerate(rows) if at != own and row is not None)
            sinks = not any(_stays(row, now_ns) for row in others)
    return NeighbourView(leg, sinks, stiffen)


def _fresh(row: NeighbourRow | None, now_ns: int) -> NeighbourRow | None:
    """Return a row if it is recent; it may be newer than the clock reading."""
    return row if row is not None and abs(now_ns - row.t_ns) <= STALE_NS else None


def _is_elsewhere(row: NeighbourRow, now_ns: int) -> bool:
    """Return True for a module on another host, or with another host's clock."""
    return row.t_ns == 0 or row.t_ns > now_ns + STALE_NS


def _stays(row: NeighbourRow, now_ns: int) -> bool:
    """Return True if a module of this host does not go down with the others."""
    if _is_elsewhere(row, now_ns):
        return False
    return now_ns - row.t_ns > GONE_NS or row.mode != Mode.DAMP or row.caught > 0


class Neighbours:
    """One module's access to the shared file."""

    def __init__(self, run_dir: Path, module: str) -> None:
        """Open the file, or create it; the directory must exist.

        Raises:
            FleetError: the file cannot be created.
        """
        self._memory = mapped(path_of(run_dir), _SIZE)
        self._module = module
        self._at = MODULES.index(module) * _ROW.size

    def write(self, row: NeighbourRow) -> None:
        """Write this module's row."""
        body = _BODY.pack(*row)
        self._memory[self._at : self._at + _ROW.size] = _SUM.pack(crc32(body)) + body

    @staticmethod
    def mode_of(run_dir: Path, module: str) -> Mode | None:
        """Return the mode last written by a module's service on this host, or None.

        A row that is being written is read again.
        """
        found: Mode | None = None
        for _ in range(READS):
            try:
                with path_of(run_dir).open("rb", buffering=0) as file:
                    file.seek(MODULES.index(module) * _ROW.size)
                    data = file.read(_ROW.size)
                row, whole = _unpacked(data)
            except (OSError, struct.error):
                return None
            found = Mode(row.mode) if any(data) and row.mode in tuple(Mode) else None
            if whole:
                break
        return found

    def view(self, now_ns: int) -> NeighbourView:
        """Return this module's view of the others."""
        return view_of(self._module, [self._read(at) for at in range(0, _SIZE, _ROW.size)], now_ns)

    def _read(self, at: int) -> NeighbourRow | None:
        row, whole = _unpacked(self._memory[at : at + _ROW.size])
        return row if whole else None  # being written; the next cycle is 2 ms away


def _unpacked(data: bytes) -> tuple[NeighbourRow, bool]:
    """Return a row, and True if it is whole."""
    checksum, *row = _ROW.unpack(data)
    return NeighbourRow(*row), checksum == crc32(data[_SUM.size :])
