"""How far gains and delay may go before any motion of the loop grows. Offline and pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from services.planner.dynamic_certificate import (
    DELAY_MIN_S,
    Condition,
    Design,
    DynamicCertificate,
)
from services.planner.sampled_loop import Gains

LADDER: Final = (1.0, 1.41, 2.0, 2.82, 4.0, 5.64, 8.0)
"""Factors tried on gains, one after the other."""
DELAYS: Final = (1.0, 5.0, 10.0, 15.0, 20.0, 24.0)
"""Times `DELAY_MIN_S`: up to the age at which a command is refused."""


class Room(NamedTuple):
    """The last factors with which everything is stable, with one drivetrain; 0: not even 1."""

    stiffness: float
    """N m/rad"""
    torque: float
    """On every feedback torque."""
    coupling: float
    """On tau_coupled."""
    delay_s: float
    """From sample to use."""


def room_of(certificate: DynamicCertificate, design: Design) -> list[Room]:
    """Return what each drivetrain leaves in hand, over all poses, hands and modes."""

    def last(
        conditions: Sequence[Condition],
        ladder: Sequence[float],
        changed: Callable[[Condition, float], Condition],
    ) -> float:
        found = 0.0
        for factor in ladder:
            if not all(certificate.judge(changed(c, factor), design).stable for c in conditions):
                break
            found = factor
        return found

    rooms = []
    for stiffness in certificate.stiffnesses:
        nominal = [c for c in certificate.conditions(margins=False) if c.stiffness == stiffness]
        led = [c for c in nominal if c.mode == "TRACK"]
        soonest = [c for c in led if c.delay_s == DELAY_MIN_S]
        rooms.append(
            Room(
                stiffness,
                last(nominal, LADDER, lambda c, f: c._replace(gains=Gains(torque=f))),
                last(led, LADDER, lambda c, f: c._replace(gains=Gains(coupling=f))),
                DELAY_MIN_S
                * last(soonest, DELAYS, lambda c, f: c._replace(delay_s=DELAY_MIN_S * f)),
            )
        )
    return rooms
