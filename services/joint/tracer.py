"""Records each cycle's inputs and decisions, so that it can be re-executed. Pure.

Nothing else records the order in which a service received its inputs: with inputs in the log's
order, 22 to 97 % of the ticks were wrong (docs/logs.md).
"""

from __future__ import annotations

from typing import Final

import msgspec

from services.joint.drive_manager import DriveAction, DriveManager
from services.joint.drivers.base import DriveReading
from services.joint.neighbours import UNKNOWN, NeighbourView
from shared.bus.messages import JointCommand
from shared.bus.traces import CycleTrace, JointTrace

CYCLES: Final = 10
"""Number of cycles in a message; the unsent cycles of a killed service are lost."""
SNAPSHOT_EVERY: Final = 50
"""Number of messages between two snapshots of the service: 1 s."""

_NOTHING: Final = (0.0, 0.0)
_UNTOLD: Final = (-1.0, -1.0)


_Cycle = tuple[
    int, DriveReading | None, JointCommand | None, bool, DriveAction, NeighbourView, int, int
]
"""A cycle's raw inputs and outcome. Converting ten at once is cheaper than converting one per cycle
with cold caches."""


class Tracer:
    """Collects the cycles of one module's service."""

    def __init__(self, module: DriveManager) -> None:
        self._module = module
        self._encode = msgspec.json.Encoder().encode
        self._cycles: list[_Cycle] = []
        self._seq = 0
        self._snapshot = ""
        self._remember()

    def after(
        self,
        now_ns: int,
        reading: DriveReading | None,
        command: JointCommand | None,
        estop: bool,
        step: DriveAction,
        near: NeighbourView = UNKNOWN,
        malformed: int = 0,
        ended: int = 0,
    ) -> JointTrace | None:
        """Record a cycle; return a message once it has `CYCLES`."""
        self._cycles.append((now_ns, reading, command, estop, step, near, malformed, ended))
        return self.take() if len(self._cycles) == CYCLES else None

    def take(self) -> JointTrace | None:
        """Return the cycles recorded since the last message, or None."""
        if not self._cycles:
            return None
        self._seq += 1
        cycles = [_trace_of(*cycle) for cycle in self._cycles]
        trace = JointTrace.of(cycles, self._seq, self._snapshot)
        self._cycles.clear()
        self._remember()
        return trace

    def _remember(self) -> None:
        """Take a snapshot if the next message carries one."""
        due = self._seq % SNAPSHOT_EVERY == 0
        self._snapshot = self._encode(self._module.state).decode() if due else ""


def _trace_of(
    now_ns: int,
    r: DriveReading | None,
    command: JointCommand | None,
    estop: bool,
    step: DriveAction,
    near: NeighbourView,
    malformed: int,
    ended: int,
) -> CycleTrace:
    torque = None if r is None else r.torque
    return CycleTrace(
        now_ns,
        -1 if r is None else r.t_ns,
        _NOTHING if r is None else r.pos_turns,
        _NOTHING if r is None else r.vel_turns,
        0 if r is None else int(r.status),
        0 if r is None else r.error,
        torque or _NOTHING,
        torque is not None,
        0 if command is None else command.session,
        -1 if command is None else command.seq,
        estop,
        step.command.value,
        near.leg or _NOTHING,
        near.leg is not None,
        near.sinks,
        near.stiffen,
        malformed,
        (r and r.encoder_zero) or _UNTOLD,
        _NOTHING if r is None else r.fet_celsius or _NOTHING,
        _NOTHING if r is None else r.motor_celsius or _NOTHING,
        0.0 if r is None else r.supply_v,
        ended,
    )
