"""What a joint service reads of the other five (`services.joint.neighbours`), in virtual time."""

from __future__ import annotations

from collections.abc import Sequence

from services.joint.module import Module
from services.joint.neighbours import NOTHING, Near, Row, near
from shared.joints import MODULES
from tools.runs.host_clock import HostClock


def near_to(
    index: int, now_ns: int, modules: Sequence[Module], clocks: Sequence[HostClock]
) -> Near:
    """Return what a module knows of the others.

    Args:
        index: of the module that asks.
        now_ns: virtual time.
        modules: all six; one whose service is dead has no new samples.
        clocks: of their hosts: each writes virtual time, as if all six were on one.
    """
    if not modules[index].asks_near:
        return NOTHING
    rows = []
    for module, clock in zip(modules, clocks, strict=True):
        controller = module.controller
        samples, late_ns = controller.samples, clock.read(now_ns) - now_ns
        t_ns = samples.believed_ns - late_ns if samples.believed_ns else 0
        rows.append(Row(t_ns, samples.q[1], samples.v[1], controller.failsafe.mode))
    return near(MODULES[index], rows, now_ns)
