"""The coupled torque, and all of the law's terms at a reference pose. Pure.

The planner adds the coupled torque, low-passed, to the local law. Along p, the local gains have the
stiffness K_fail = T^T D T + K_geo (`services.planner.law.certificate`) and the damping T^T D_B T.
In the closed rows of p, they lack this part of the body's K_p and B_p (paper, section IV):

    K_c = (K_p - K_fail)+        B_c = (c B_p - T^T D_B T)+        c: `coupling_damping`

(.)+ is the positive part: the planner adds stiffness and damping, but never removes any. It
requests

    tau_coupled = low-pass { J^T [K_c (p_ref - p) + B_c (pdot_ref - pdot) + F_I] }

through two poles at `coupling_bandwidth_hz`. `tools.lab.design.dynamic_certificate` shows which
bandwidth and damping are safe on flexible joints (docs/law.md#flexible-joints).

`LawAtReference` computes local gains and coupled torque at a pose (paper, section IV), for the
planner's tick and for `xrl log explain` (`tools.lab.design.torque_breakdown`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np

from services.planner.law.reference import Reference
from services.planner.law.small_matrices import positive_part
from services.planner.law.split import GainLaw, GainSplit, JointGains, LocalGains
from shared.arrays import Array
from shared.clamp import clamp
from shared.config.sections import LawConfig
from shared.joints import N_JOINTS

Y = 1
"""Row of y in p."""
FAST = 0.04
"""m/s; the integral ignores an error that changes faster, as in a shove and the sway after it. With
the whole error, a shoved robot swung to the other side twice as far as without an integral."""
GAIN_MIN = 1e-9
"""Smaller gains of the body are not scaled."""


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
        """Return K_c and B_c (6, 6), symmetric and positive semidefinite: docs/law.md (16).

        Zero where the closed chain has no finite rates: nothing can be added there.

        Args:
            K_fail: stiffness of the local gains along p (6, 6).
            B_local: T^T D_B T (6, 6).
        """
        return self._lacking(self._stiffness, K_fail), self._lacking(self._damping, B_local)

    def _lacking(self, body: tuple[Array, Array], local: Array) -> Array:
        """Return the part of the body's gains (with their scale) that local gains (6, 6) lack."""
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

        F_I' = (1 - |e_y'| / FAST)+ K_p e_y / push_integral_s,    |F_I| <= push_integral_max

    The legs share F_I, so that it balances a push from the side with little moment at each sole.
    The local springs alone would need more moment, and a sole could tip.

    HOLD drops F_I with the coupled torque, so HOLD must withstand a push of `push_integral_max`.
    Along x it has no such reserve, so there is no integral along x.

    Attributes:
        gain: rate of the force per error, N/(m s); 0 if y is led or the split is the paper's.
        most: maximum force, N. The dynamic certificate holds for any maximum.
    """

    def __init__(self, law: LawConfig) -> None:
        closed = law.split == "certified" and not law.S[Y]
        self.gain = law.K_p[Y] / law.push_integral_s if closed else 0.0
        self.most = law.push_integral_max if closed else 0.0

    def after(self, force: float, error: float, rate: float, dt: float) -> float:
        """Return F_I after dt seconds, N.

        Args:
            force: F_I before, N.
            error: error of y, m.
            rate: rate of the error, m/s.
            dt: time since the last tick, s.
        """
        slow = max(0.0, 1.0 - abs(rate) / FAST)
        return clamp(force + dt * slow * self.gain * error, -self.most, self.most)


class CouplingState(msgspec.Struct):
    """State of the coupled torque."""

    first: tuple[float, ...] = (0.0,) * N_JOINTS
    """Output of the low-pass's first pole, N m."""
    second: tuple[float, ...] = (0.0,) * N_JOINTS
    """Output of its second pole, N m."""
    push: float = 0.0
    """F_I, N."""


def low_passed(s: CouplingState, tau: Array, bandwidth_hz: float, dt: float) -> Array:
    """Return tau_coupled (12,), N m, after two equal poles: docs/law.md (18).

    Args:
        s: state of both poles; updated in place.
        tau: unfiltered torque (12,), N m.
        bandwidth_hz: bandwidth of each pole.
        dt: time since the last tick, s.
    """
    gain = pole_gain(bandwidth_hz, dt)
    first, second = np.array(s.first), np.array(s.second)
    first += gain * (tau - first)
    second += gain * (first - second)
    s.first, s.second = tuple(first.tolist()), tuple(second.tolist())
    return second


class _LawTerms(NamedTuple):
    """One tick's gains, and its coupled torque before any filter."""

    body_gains: Callable[[], JointGains]
    """Computes K_q and B_q of the whole body, if the split needs them."""
    local: LocalGains
    """D and D_B, with their margins."""
    coupled: Array
    """J^T [K_c e_p + B_c e_pdot] (12,), N m, which the planner adds to the local law."""


class LawAtReference:
    """The law's terms at a pose, without state."""

    def __init__(self, gains: GainLaw, split: GainSplit) -> None:
        self._gains, self._split = gains, split
        self._uncoupled = UncoupledGains(gains.K_p, gains.B_p, gains.S, split.coupling.damping)

    def evaluate(self, reference: Reference, e_p: Array, e_pdot: Array) -> _LawTerms:
        """Return the terms: docs/law.md (9).

        Args:
            reference: evaluated at the reference pose.
            e_p: p_ref - p (6,), m and rad.
            e_pdot: pdot_ref - pdot (6,), m/s and rad/s.
        """
        T, p, inputs = reference.T, reference.p, reference.inputs

        def body_gains() -> JointGains:
            F = self._gains.K_p * e_p + self._gains.B_p * e_pdot + inputs.F_O
            kinematics = reference.kinematics()
            return self._gains.gains(kinematics, kinematics.hessian_times(F, inputs.F_assist))

        local = self._split.split(body_gains, float(p[2]), float(p[4]), T, reference.hessian_O)
        K_fail = self._split.certificate.failsafe_stiffness(local.D)
        K_c, B_c = self._uncoupled.at(K_fail, (T.T * local.D_B) @ T)
        return _LawTerms(body_gains, local, (K_c @ e_p + B_c @ e_pdot) @ reference.J)
