"""A jog: one axis there and back; what a person should see, and the verdict. Pure."""

from __future__ import annotations

import math
from statistics import fmean
from typing import Final, NamedTuple

from shared.bus.messages import Pair
from shared.joints import AXES, kind_of
from tools.bringup.motion import SETTLE_S, MotionPlan, Sample

TRAVEL_SHARE: Final = 0.25
"""Fraction of the requested travel by which the travel may differ."""
LAG_MAX: Final = 0.02
"""rad between reference and joint, beyond the deflection by its load at rest."""
SIBLING_MAX: Final = 0.02
"""rad that the other axis may move."""


class ThereAndBack(NamedTuple):
    """by/2 (1 - cos) along the axis, some times."""

    by: float
    """rad, there and back."""
    period_s: float
    """Period of one motion there and back, s."""
    cycles: int

    @property
    def duration_s(self) -> float:
        """Duration of all cycles."""
        return self.cycles * self.period_s

    @property
    def span(self) -> Pair:
        """Lowest and highest offset, rad."""
        return min(0.0, self.by), max(0.0, self.by)

    @property
    def rate_max(self) -> float:
        """Fastest rate that it asks for, rad/s."""
        return math.pi * abs(self.by) / self.period_s

    def at(self, t_s: float) -> Pair:
        """Return offset, rad, and rate, rad/s."""
        omega = 2.0 * math.pi / self.period_s
        return (
            0.5 * self.by * (1.0 - math.cos(omega * t_s)),
            0.5 * self.by * omega * math.sin(omega * t_s),
        )


JogPlan = MotionPlan[ThereAndBack]


class JogCheck(NamedTuple):
    """One line of the verdict."""

    what: str
    value: str
    wanted: str
    """Remedy; "" if there is none."""
    good: bool


def what_to_see(module: str, axis: int, by: float) -> str:
    """Return a description of the right motion, for a person who watches.

    A positive angle leans the part above the joint forward (theta) or to the right (phi)
    against the part below; below a hanging torso, the lower part swings the same way.
    """
    kind, positive = kind_of(module), by > 0.0
    upper = {"ankle": "shin", "knee": "thigh", "hip": "torso"}[kind]
    if axis == 1:
        way = "forward" if positive else "back"
        foot = "the toes point up" if positive else "the toes point down"
    else:
        way = "to its right" if positive else "to its left"
        foot = f"the sole turns its {'right' if positive else 'left'} edge up"
    lower = {"ankle": foot, "knee": f"the shin swings {way}", "hip": f"the thigh swings {way}"}
    return f"the {upper} leans {way}; where the torso hangs, {lower[kind]}"


def judge(samples: list[Sample], plan: JogPlan) -> list[JogCheck]:
    """Return the verdict on a jog that came to its end."""
    axis, other, by = plan.axis, 1 - plan.axis, plan.course.by
    rest = [s for s in samples if s.t_s < SETTLE_S][-20:]
    moving = [s for s in samples if SETTLE_S <= s.t_s <= plan.duration_s - SETTLE_S]
    if not rest or not moving:
        found = f"{len(rest)} at rest, {len(moving)} moving"
        return [JogCheck("samples", found, "some of both", False)]
    q_rest = fmean([s.q[axis] for s in rest])
    sag = q_rest - rest[-1].q_ref[axis]
    sign = math.copysign(1.0, by)
    travel = sign * max(sign * (s.q[axis] - q_rest) for s in moving)
    lag = max(abs(s.q[axis] - s.q_ref[axis] - sag) for s in moving)
    still = fmean([s.q[other] for s in rest])
    strayed = max(abs(s.q[other] - still) for s in moving)
    peak = max(abs(s.tau[0]) + abs(s.tau[1]) for s in samples)
    went, wanted = f"{travel:+.4f} rad", f"{by:+.4f} within {TRAVEL_SHARE:.0%}"
    at_rest = f"{fmean([s.tau[axis] for s in rest]):+.2f} N m"
    stray_max = f"<= {SIBLING_MAX:g}"
    return [
        JogCheck(f"{AXES[axis]} went", went, wanted, abs(travel - by) <= TRAVEL_SHARE * abs(by)),
        JogCheck("largest lag", f"{lag:.4f} rad", f"<= {LAG_MAX:g}", lag <= LAG_MAX),
        JogCheck(f"{AXES[other]} strayed", f"{strayed:.4f} rad", stray_max, strayed <= SIBLING_MAX),
        JogCheck("torque at rest", at_rest, "", True),
        JogCheck("largest torque, both axes", f"{peak:.2f} N m", f"< {plan.torque_limit:g}", True),
        JogCheck("friction, dry and viscous", f"{friction(moving, plan):.2f} N m", "", True),
    ]


def friction(moving: list[Sample], plan: JogPlan) -> float:
    """Return half the difference of torque between the way there and the way back, N m.

    Only where the motion is fast; gravity and springs are the same on both ways and cancel.
    """
    omega = 2.0 * math.pi / plan.course.period_s
    sign = math.copysign(1.0, plan.course.by)
    there: list[float] = []
    back: list[float] = []
    for s in moving:
        sine = math.sin(omega * (s.t_s - SETTLE_S))
        if abs(sine) > 0.5:
            (there if sine > 0.0 else back).append(sign * s.tau[plan.axis])
    return 0.5 * (fmean(there) - fmean(back)) if there and back else math.nan
