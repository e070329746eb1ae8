"""Computes the coupled torque, which the planner adds to the local gains, low-passed. Pure.

Alone, the local gains stand with K_fail = T^T D T + K_geo (`services.planner.law.certificate`) and
damp with T^T D_B T. In the closed rows of p, the rest of the body's K_p and B_p (paper, section IV)
is

    K_c = (K_p - K_fail)+        B_c = (c B_p - T^T D_B T)+        c: `coupling_damping`

(.)+ keeps the positive part: the planner only ever adds stiffness and damping. It requests

    tau_coupled = low-pass { J^T [K_c (p_ref - p) + B_c (pdot_ref - pdot) + F_I] }

through two poles at `coupling_bandwidth_hz`. The feedback is some milliseconds old and acts on the
bare rotors of a flexible drivetrain. Without the filter, the robot shook below 40 000 N m/rad and
fell. `tools.lab.design.dynamic_certificate` computes which bandwidth and damping are safe.
"""

from __future__ import annotations

import math

import numpy as np

from services.planner.law.small_matrices import positive_part
from shared.arrays import Array
from shared.clamp import clamp
from shared.config.sections import LawConfig
from shared.joints import N_JOINTS

Y = 1
"""Row of p."""
FAST = 0.04
"""m/s; the integral takes no error that changes so fast: a shove, and the sway after it. With all
of the error, a robot shoved to one side swung to the other twice as far as without an integral."""
GAIN_MIN = 1e-9
"""Smallest gain of the body; a smaller one counts as zero."""


class UncoupledGains:
    """K_c and B_c: the body's stiffness and damping that the local gains lack."""

    def __init__(self, K_p: Array, B_p: Array, S: Array, damping: float) -> None:
        """Set the body's gains.

        Args:
            K_p: (6,) N/m and N m/rad.
            B_p: (6,) N s/m and N m s/rad.
            S: (6,), 1 where the person leads: nothing is added there.
            damping: c, as a fraction of B_p.
        """
        closed = np.flatnonzero(S == 0.0)
        self._indices = 6 * closed[:, np.newaxis] + closed
        """Flat indices of the closed rows and columns in a (6, 6) matrix."""
        self._stiffness = _scaled(K_p[closed])
        self._damping = _scaled(damping * B_p[closed])

    def at(self, K_fail: Array, B_local: Array) -> tuple[Array, Array]:
        """Return K_c and B_c (6, 6), symmetric and not negative: docs/law.md (16).

        Zero at angles at which the closed chain has no finite rates: nothing can be added there.

        Args:
            K_fail: stiffness of the local gains along p (6, 6).
            B_local: T^T D_B T (6, 6).
        """
        return self._lacking(self._stiffness, K_fail), self._lacking(self._damping, B_local)

    def _lacking(self, body: tuple[Array, Array], local: Array) -> Array:
        """Return what local gains (6, 6) lack of the body's, given with its scale."""
        gains, scale = body
        lacking: Array = np.zeros((6, 6))
        scaled = (gains - local.take(self._indices)) / scale
        if np.isfinite(scaled).all():
            lacking.put(self._indices, positive_part(scaled) * scale)
        return lacking


def _scaled(gains: Array) -> tuple[Array, Array]:
    """Return gains (n,) as a diagonal matrix, and its scale (n, n) for metres and radians."""
    root = np.sqrt(np.where(gains > GAIN_MIN, gains, 1.0))
    return np.diag(gains), np.outer(root, root)


def pole_gain(bandwidth_hz: float, dt: float) -> float:
    """Return the step of a first-order pole towards its input in dt (s), as a fraction 0 .. 1."""
    return 1.0 - math.exp(-2.0 * math.pi * bandwidth_hz * dt)


class PushIntegral:
    """F_I: force along y that grows against a lasting push, until the error is gone.

    A push from the side is then borne by the coupled torque, whose load sharing asks little of a
    sole, and no longer by the local springs, which bend the feet's shares until a sole tips:

        F_I' = (1 - |e_y'| / FAST)+ K_p e_y / push_integral_s,    |F_I| <= push_integral_max

    HOLD drops it with the coupled torque: `push_integral_max` is a push that HOLD stands. Along x
    there is none: there HOLD has no such room.

    Attributes:
        gain: rate of the force per error, N/(m s); 0: the direction is led, or the split the
            paper's. The dynamic certificate holds for any limit.
        most: the limit, N.
        force: F_I, N.
    """

    def __init__(self, law: LawConfig) -> None:
        """Start at rest."""
        closed = law.split == "certified" and not law.S[Y]
        self.gain = law.K_p[Y] / law.push_integral_s if closed else 0.0
        self.most = law.push_integral_max if closed else 0.0
        self.force = 0.0

    def advance(self, error: float, rate: float, dt: float) -> None:
        """Integrate for dt seconds, within the limit.

        Args:
            error: of y, m.
            rate: of the error, m/s.
            dt: time since the last tick, s.
        """
        slow = max(0.0, 1.0 - abs(rate) / FAST)
        self.force = clamp(self.force + dt * slow * self.gain * error, -self.most, self.most)


class CoupledTorque:
    """tau_coupled: the body's request with its integral, through a low-pass with two equal poles.

    Attributes:
        integral: F_I.
    """

    def __init__(self, bandwidth_hz: float, integral: PushIntegral) -> None:
        """Start at rest."""
        self.integral = integral
        self._bandwidth_hz = bandwidth_hz
        self._first: Array = np.zeros(N_JOINTS)
        self._second: Array = np.zeros(N_JOINTS)

    def advance(self, tau: Array, dt: float) -> Array:
        """Return the filtered torque (12,), N m: docs/law.md (18).

        Args:
            tau: unfiltered (12,), N m.
            dt: time since the last tick, s.
        """
        gain = pole_gain(self._bandwidth_hz, dt)
        self._first += gain * (tau - self._first)
        self._second += gain * (self._first - self._second)
        return self._second.copy()

    def reset(self) -> None:
        """Reset filter and integral to zero."""
        self._first[:] = self._second[:] = self.integral.force = 0.0

    def snapshot(self) -> tuple[float, ...]:
        """Return both poles' states (24,), N m, and F_I, N."""
        return (*self._first.tolist(), *self._second.tolist(), self.integral.force)

    def restore(self, state: tuple[float, ...]) -> None:
        """Continue from a state that `snapshot` returned."""
        self._first[:], self._second[:] = state[:N_JOINTS], state[N_JOINTS : 2 * N_JOINTS]
        self.integral.force = state[2 * N_JOINTS]
