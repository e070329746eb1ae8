"""Local gains and coupled torque at a reference pose (paper, section IV). Pure.

The planner's tick and `xrl log explain` (`tools.lab.design.torque_breakdown`) both call it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from services.planner.law.coupling import UncoupledGains
from services.planner.law.gains import GainLaw, JointGains
from services.planner.law.reference import Reference
from services.planner.law.split import GainSplit, LocalGains
from shared.arrays import Array


class LawTerms(NamedTuple):
    """One tick's gains, and its coupled torque before any filter."""

    body_gains: Callable[[], JointGains]
    """Computes K_q and B_q of all the body; the certified split does not need them."""
    local: LocalGains
    """D and D_B, certified."""
    coupled: Array
    """J^T [K_c e_p + B_c e_pdot] (12,), N m, which the planner adds to the local gains."""


class LawAtReference:
    """The law's terms at a pose, without state."""

    def __init__(self, gains: GainLaw, split: GainSplit) -> None:
        """Set the body's gains and how they are split."""
        self._gains, self._split = gains, split
        self._uncoupled = UncoupledGains(gains.K_p, gains.B_p, gains.S, split.coupling.damping)

    def evaluate(self, reference: Reference, e_p: Array, e_pdot: Array) -> LawTerms:
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
        return LawTerms(body_gains, local, (K_c @ e_p + B_c @ e_pdot) @ reference.J)
