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

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.planner.law.small_matrices import positive_part
from shared.clamp import clamp
from shared.config.sections import LawConfig
from shared.joints import N_JOINTS

Array = NDArray[np.float64]


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


class CoupledState(msgspec.Struct, frozen=True):
    """State of `CoupledTorque`."""

    first: tuple[float, ...] = (0.0,) * N_JOINTS
    """N m"""
    second: tuple[float, ...] = (0.0,) * N_JOINTS
    force: tuple[float, ...] = ()
    """F_I, N; () is at rest."""


class BodyIntegral:
    """F_I: force along x and y that grows against a lasting push, until the error is gone.

    It uses plain floats: for two values, NumPy's calls cost more than the arithmetic.

    A push that lasts is then borne by the coupled torque, whose load sharing asks little of a
    sole, and no longer by the local springs, which bend the feet's shares until a sole tips:

        F_I' = (1 - |e_p'| / FAST)+ K_p e_p / push_integral_s,    |F_I| <= push_integral_max

    HOLD drops it with the coupled torque: `push_integral_max` is a push that HOLD stands.

    Attributes:
        rows: of p that are closed and integrated, also those with a limit of 0: the dynamic
            certificate holds for any limit.
        gains: rate of the force per error, N/(m s).
        force: along these rows, N.
    """

    def __init__(self, law: LawConfig) -> None:
        """Start at rest."""
        certified = law.split == "certified"  # the paper's has none
        self.rows = [row for row in (0, 1) if certified and not law.S[row]]
        self.gains = [law.K_p[row] / law.push_integral_s[row] for row in self.rows]
        self._most = [law.push_integral_max[row] for row in self.rows]
        self.force = [0.0] * len(self.rows)
        self._F: Array = np.zeros(6)

    def advance(self, e_p: Array, e_pdot: Array, dt: float) -> None:
        """Integrate for dt seconds, within the limits.

        Args:
            e_p: p_ref - p (6,), m and rad.
            e_pdot: its rate (6,).
            dt: time since the last tick, s.
        """
        for at, row in enumerate(self.rows):
            slow = max(0.0, 1.0 - abs(float(e_pdot[row])) / FAST)
            force = self.force[at] + dt * slow * self.gains[at] * float(e_p[row])
            self.force[at] = clamp(force, -self._most[at], self._most[at])

    def torque(self, J: Array) -> Array:
        """Return J^T F_I (12,), N m; J is (6, 12)."""
        self._F[self.rows] = self.force
        torque: Array = self._F @ J
        return torque


class CoupledTorque:
    """tau_coupled: the body's request with its integral, through a low-pass with two equal poles.

    Attributes:
        integral: F_I.
    """

    def __init__(self, bandwidth_hz: float, integral: BodyIntegral) -> None:
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
        self._first[:] = self._second[:] = 0.0
        self.integral.force = [0.0] * len(self.integral.rows)

    def snapshot(self) -> CoupledState:
        """Return the state between two ticks."""
        first, second = tuple(self._first.tolist()), tuple(self._second.tolist())
        return CoupledState(first, second, tuple(self.integral.force))

    def restore(self, state: CoupledState) -> None:
        """Continue from a state that `snapshot` returned."""
        self._first[:], self._second[:] = state.first, state.second
        self.integral.force = list(state.force) or [0.0] * len(self.integral.rows)
