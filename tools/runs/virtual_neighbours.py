"""What a joint service reads of the other five (`services.joint.neighbours`), in virtual time."""

from __future__ import annotations

from collections.abc import Container, Sequence

from services.joint.controller import row_of
from services.joint.drive_manager import DriveManager
from services.joint.neighbours import UNKNOWN, NeighbourView, view_of
from shared.robot.joints import MODULES
from tools.runs.host_clock import HostClock


def near_to(
    index: int,
    now_ns: int,
    modules: Sequence[DriveManager],
    clocks: Sequence[HostClock],
    dead: Container[str],
) -> NeighbourView:
    """Return what a module knows of the others.

    Args:
        index: of the module that asks.
        now_ns: virtual time.
        modules: all six; one whose service is dead has no new samples.
        clocks: of their hosts: each writes virtual time, as if all six were on one.
        dead: services that are no more, though their rows are still there.
    """
    if not modules[index].needs_neighbours:
        return UNKNOWN
    rows = []
    for name, module, clock in zip(MODULES, modules, clocks, strict=True):
        row, late_ns = row_of(module.controller), clock.read(now_ns) - now_ns
        t_ns = row.t_ns - late_ns if row.t_ns else int(name in dead)
        rows.append(row._replace(t_ns=t_ns))
    return view_of(MODULES[index], rows, now_ns)
