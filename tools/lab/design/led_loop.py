"""Where easing and assist are stable in the loop with the person's hand (docs/law.md#harness)."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from typing import Final

import msgspec

_W_RAD_S: Final = tuple(10.0 ** (exponent / 1000.0) for exponent in range(-1000, 3000))
"""0.1 to 1000 rad/s: from a person's slowest lead to far beyond a joint service's bandwidth."""


class LedLoop(msgspec.Struct, frozen=True, kw_only=True):
    """Robot, hand and the path between them, in one direction (z or pitch).

    m s^2 x = -(b_r s + k_r) x + w,   w = -(b s + k) x      (units of the direction)
    """

    mass: float
    """m: effective mass of the robot, kg, or inertia, kg m^2."""
    b_r: float
    """Damping of the robot: joints, and local gains that references do not cancel."""
    k_r: float
    """Stiffness of the robot: 0 in directions that the operator leads."""
    k: float
    """Stiffness of the hand."""
    b: float
    """Damping of the hand."""
    delay_s: float
    """From wrench to torque, s: one bus transfer each way, and the periods between."""
    low_pass_hz: float
    """Bandwidth of the harness filter, Hz."""

    def force_by_force(self, s: complex) -> complex:
        """Return G: the hand's force response to a force of the robot, delayed and filtered.

        G(s) = (b s + k) / (m s^2 + (b + b_r) s + k + k_r) e^(-s delay) / (1 + s / w_f)
        """
        hand = self.b * s + self.k
        robot = (self.mass * s + self.b_r) * s + self.k_r
        late = cmath.exp(-s * self.delay_s) / (1.0 + s / (2.0 * math.pi * self.low_pass_hz))
        return hand / (robot + hand) * late


def alpha_max(loop: LedLoop) -> float:
    """Return the alpha below which the eased lead is stable; infinite if every alpha is.

    Robot and hand, with alpha w fed back: 1 + alpha G(s) = 0. By Nyquist it is stable if

        alpha |G(j w)| < 1   wherever the phase of G(j w) is -180 degrees

    Seen from the hand, a force late by t is damping of -alpha k t. For slow modes this requires
    alpha (k t - b) < b + b_r. A well damped hand (k t < b) is then limited at higher frequencies
    only, where m dominates: alpha < m w / b, about.
    """
    return gain_max(loop.force_by_force)


def integral_s_min(loop: LedLoop) -> float:
    """Return the time constant above which the integral on the assist is stable, s.

    The measured force follows the assist by G, so the loop is G / (integral_s s). With no delay and
    a robot that is a pure mass, the limit is m / b - b / k.
    """
    limit = gain_max(lambda s: loop.force_by_force(s) / s)
    return 1.0 / limit


def gain_max(loop: Callable[[complex], complex]) -> float:
    """Return the gain below which a loop that is stable at rest is stable when closed."""
    limit = math.inf
    low = _W_RAD_S[0]
    for high in _W_RAD_S[1:]:
        a, b = loop(1j * low), loop(1j * high)
        if a.imag * b.imag <= 0.0 and a.real + b.real < 0.0:
            fraction = a.imag / (a.imag - b.imag)
            limit = min(limit, -1.0 / (a.real + fraction * (b.real - a.real)))
        low = high
    return limit
