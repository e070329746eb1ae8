"""Searches the gain and delay at which a motion of the loop begins to grow. Offline and pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

from tools.lab.design.dynamic_certificate import (
    DELAY_MIN_S,
    Condition,
    Design,
    DynamicCertificate,
)
from tools.lab.design.sampled_loop import Gains

LADDER: Final = (1.0, 1.41, 2.0, 2.82, 4.0, 5.64, 8.0)
"""Factors tried on gains, in ascending order."""
DELAYS: Final = (1.0, 5.0, 10.0, 15.0, 20.0, 24.0)
"""Multiples of `DELAY_MIN_S`, up to the age at which a command is refused."""


class StabilityMargins(NamedTuple):
    """Largest factors that keep one drivetrain stable in every condition; 0 if not even 1 does."""

    stiffness: float
    """N m/rad"""
    torque: float
    """On every feedback torque."""
    coupling: float
    """On tau_coupled."""
    delay_s: float
    """From a sample to the use of its command, s."""


def stability_margins_of(certificate: DynamicCertificate, design: Design) -> list[StabilityMargins]:
    """Return the room that each drivetrain leaves, over all poses, hands and modes."""

    def highest_stable(
        conditions: Sequence[Condition],
        ladder: Sequence[float],
        scaled: Callable[[Condition, float], Condition],
    ) -> float:
        highest = 0.0
        for factor in ladder:
            if not all(certificate.judge(scaled(c, factor), design).stable for c in conditions):
                break
            highest = factor
        return highest

    rooms = []
    for stiffness in certificate.stiffnesses:
        nominal = [c for c in certificate.conditions(margins=False) if c.stiffness == stiffness]
        led = [c for c in nominal if c.mode == "TRACK"]
        least_delayed = [c for c in led if c.delay_s == DELAY_MIN_S]
        rooms.append(
            StabilityMargins(
                stiffness,
                highest_stable(nominal, LADDER, lambda c, f: c._replace(gains=Gains(torque=f))),
                highest_stable(led, LADDER, lambda c, f: c._replace(gains=Gains(coupling=f))),
                DELAY_MIN_S
                * highest_stable(
                    least_delayed, DELAYS, lambda c, f: c._replace(delay_s=DELAY_MIN_S * f)
                ),
            )
        )
    return rooms
