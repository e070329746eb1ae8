"""Shared memory with four values for each joint service, independent of the bus.

The first is the service's last state, for its successor. A module that lost torque is never
re-armed automatically (`shared.robot.fault_table`). But the supervisor restarts a crashed service,
whose drive may have disarmed, or whose emergency stop may be active. Without the last state, the
new service would arm and stiffen the module unasked. A person's command for the module (`xrl kill`,
`xrl start`, `xrl up`) clears all four values.

The second is an emergency stop from the robot's own host (`xrl estop`). It works with the planner
dead and every link of the bus cut, and stays active until a person restarts the module.

The third is the pendant's count of beats. The fourth is the source of the active emergency stop,
for `xrl status`.

The file is mapped: reading and writing it are loads and stores, which the control path may do.

The pendant is a dead man's handle: all six modules stop when it falls silent. Any failure between
the person's hand and the robot (cable, radio or host) causes silence. The pendant writes its beats
to each module's shared memory, without a bus. No silence is counted before the first beat, or after
the pendant has been laid down properly. Silence is counted in the module's cycles, so a pause of
the whole machine does not count.
"""

from __future__ import annotations

import mmap
import os
import signal
import struct
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import Final

from shared.clock import NS_PER_MS
from shared.run_directory import live_dir, mapped

_LAST_STATE, _STOP = range(2)
_BEATS: Final = struct.Struct("<Q")
_BEATS_AT: Final = 8
"""Aligned, so that a store to it is atomic."""
_SOURCE_AT: Final = _BEATS_AT + _BEATS.size
SOURCE_MAX: Final = 80
"""Maximum length of a stop's source, bytes."""
_NEW: Final = bytes(_SOURCE_AT + SOURCE_MAX)
PENDANT: Final = "a pendant that went silent"


class LastState(IntEnum):
    """Last state of the service before this one."""

    NOTHING = 0
    """No service armed the drive, the fleet was stopped, or a person has requested the module."""
    HELD = 1
    """It held the robot, so if the drive is not armed, the drive has lost torque."""
    DAMP = 2
    """It was in DAMP or an emergency stop was active, so the next service starts in DAMP."""


def path_of(run_dir: Path, module: str) -> Path:
    """Return the path of a module's rearm-guard file."""
    return live_dir(run_dir) / f"{module}.rearm"


class RearmGuard:
    """A module's rearm guard: a file in the live directory that several processes map."""

    def __init__(self, run_dir: Path, module: str) -> None:
        """Open the file, or create it; the directory must exist.

        Raises:
            FleetError: the file cannot be created.
        """
        self._memory = mapped(path_of(run_dir, module), len(_NEW))
        self._written = self.read()

    def read(self) -> LastState:
        """Return the last state; an unreadable value is treated as HELD."""
        value = self._memory[_LAST_STATE]
        return LastState(value) if value in tuple(LastState) else LastState.HELD

    def write(self, last_state: LastState) -> None:
        """Write the last state if it has changed, so a running service does not undo `clear`."""
        if last_state is not self._written:
            self._memory[_LAST_STATE] = self._written = last_state

    def note_stop(self, source: str) -> None:
        """Store the source of the emergency stop, unless one is stored already."""
        if self._memory[_SOURCE_AT] == 0 and source:
            kept = _kept(source)
            self._memory[_SOURCE_AT : _SOURCE_AT + len(kept)] = kept

    def stop_on(self, number: signal.Signals) -> None:
        """Engage the emergency stop on a signal, which works even if the memory's file is gone."""

        def engage(_number: int, _frame: FrameType | None) -> None:
            self._memory[_STOP] = 1
            self.note_stop(f"signal {number.name}")

        signal.signal(number, engage)

    @property
    def stop_requested(self) -> bool:
        """True if the emergency stop was set on this host."""
        return self._memory[_STOP] != 0

    @property
    def beats(self) -> int:
        """Number of beats of the pendant; 0 without a pendant."""
        return int(_BEATS.unpack_from(self._memory, _BEATS_AT)[0])


def clear(run_dir: Path, *modules: str) -> None:
    """Clear the stored values of modules, because a person restarts or re-arms them.

    The files are cleared in place, because a running service has them mapped. If an existing file
    cannot be opened, none is cleared.
    """
    with ExitStack() as stack:
        files = []
        for module in modules:
            with suppress(FileNotFoundError):
                files.append(stack.enter_context(path_of(run_dir, module).open("r+b")))
        for file in files:
            file.write(_NEW)


def stop_source(run_dir: Path, module: str) -> str:
    """Return the source of a module's emergency stop; empty if it is unknown or not engaged."""
    try:
        with path_of(run_dir, module).open("rb") as file:
            file.seek(_SOURCE_AT)
            return file.read(SOURCE_MAX).rstrip(b"\0").decode(errors="replace")
    except OSError:
        return ""


def _kept(source: str) -> bytes:
    return source.encode(errors="replace")[:SOURCE_MAX]


def request_stop(run_dir: Path, module: str, source: str = "") -> bool:
    """Request a module's emergency stop, even without a bus.

    Returns False if the module has no service on this host.

    Args:
        run_dir: the fleet's run directory.
        module: name of the module.
        source: name of the person or process that requests the stop.

    Raises:
        OSError: the file exists but cannot be written.
    """
    path = path_of(run_dir, module)
    if not path.exists():
        return False
    # the user who stops the robot may not own the directory
    descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    try:
        os.pwrite(descriptor, b"\x01", _STOP)  # first, because the stop matters more than the name
        if source and not os.pread(descriptor, 1, _SOURCE_AT).strip(b"\0"):
            os.pwrite(descriptor, _kept(source), _SOURCE_AT)
    finally:
        os.close(descriptor)
    return True


class Pendant:
    """Sending side of the pendant, for the modules whose services are on this host."""

    def __init__(self, run_dir: Path, modules: Sequence[str]) -> None:
        """Open the modules' files; a module without a file has no service on this host.

        Raises:
            OSError: a file exists but cannot be written.
        """
        self._memories = {}
        self._beats = 0
        for module in modules:
            with suppress(FileNotFoundError), path_of(run_dir, module).open("r+b") as file:
                file.truncate(len(_NEW))  # a starting service may not have sized it yet
                self._memories[module] = mmap.mmap(file.fileno(), len(_NEW))

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that the pendant reaches."""
        return tuple(self._memories)

    @property
    def beats(self) -> tuple[int, ...]:
        """Beats that the modules read, of this pendant or of another."""
        return tuple(_BEATS.unpack_from(row, _BEATS_AT)[0] for row in self._memories.values())

    def beat(self) -> None:
        """Signal that the pendant is held; after the first beat, silence stops the modules."""
        self._beats += 1
        self._write_beats(self._beats)

    def lay_down(self) -> None:
        """End the pendant's watch: it no longer has to be held."""
        self._write_beats(0)

    def _write_beats(self, beats: int) -> None:
        for memory in self._memories.values():
            # packing in place would write zeros first, which mean that there is no pendant
            memory[_BEATS_AT : _BEATS_AT + _BEATS.size] = _BEATS.pack(beats)


CYCLE_MAX_NS: Final = 20 * NS_PER_MS
"""Maximum time between two cycles that counts as silence, ns."""


class PendantWatch:
    """Watches the pendant for one module.

    Attributes:
        lost: True while a pendant has been silent for too long.
    """

    def __init__(self, silent_ms: float) -> None:
        """Set the maximum silence, ms."""
        self._silent_ns = round(silent_ms * NS_PER_MS)
        self._beats = 0
        self._last_ns = 0
        self._silence_ns = 0
        self.lost = False

    def is_lost(self, now_ns: int, beats: int) -> bool:
        """Count one cycle; return `lost`.

        Args:
            now_ns: this module's clock.
            beats: `RearmGuard.beats` in this cycle.
        """
        if beats == self._beats:
            self._silence_ns += min(CYCLE_MAX_NS, now_ns - self._last_ns)
        else:
            self._beats, self._silence_ns = beats, 0
        self._last_ns = now_ns
        self.lost = beats > 0 and self._silence_ns > self._silent_ns
        return self.lost
