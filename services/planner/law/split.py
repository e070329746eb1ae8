"""Joint gains of the whole body, and their local part, which the joint services apply. Pure.

Joint stiffness and damping of the whole body are (paper section III)

    K_q = N K_0 + J^T K_p J - sum_i H_i F_i,    B_q = N B_0 + J^T B_p J,    N = I - J^+ J.

The split chooses the local part D (docs/law.md#gain-split). `certified` takes D from the schedule
computed offline; `diagonal` is the paper's diag(K_q). In both cases the certificate checks D. If D
misses a margin, the split stiffens it in steps. If no step meets the margins, the gains are
marked UNCERTIFIED and the robot must hold.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np

from services.planner.law.certificate import Certificate, Margins
from services.planner.law.kinematics import Kinematics
from shared.arrays import Array
from shared.bus.messages import SplitSource
from shared.clamp import clamp
from shared.config import gain_schedule
from shared.config.gain_table import GainSchedule
from shared.config.robot_config import RobotConfig
from shared.exceptions import ConfigError
from shared.joints import MODULES, N_JOINTS


class JointGains(NamedTuple):
    """Whole-body joint gains."""

    K_q: Array
    """(12, 12) N m/rad, symmetric."""
    B_q: Array
    """(12, 12) N m s/rad, symmetric."""


class GainLaw:
    """Whole-body joint gains at a configuration."""

    def __init__(self, config: RobotConfig) -> None:
        """Filter K_p and B_p by S_perp: both are 0 in the directions that the operator leads."""
        law = config.law
        self.S: Array = np.array(law.S, dtype=float)
        closed = 1.0 - self.S
        self.K_p: Array = np.array(law.K_p) * closed
        self.B_p: Array = np.array(law.B_p) * closed
        self._K_0, self._B_0 = law.K_0, law.B_0
        self._damping = law.damping_lambda**2 * np.eye(6)
        self._identity = np.eye(N_JOINTS)

    def gains(self, kinematics: Kinematics, hessian_F: Array) -> JointGains:
        """Return the gains: docs/law.md (10) and (11).

        Args:
            kinematics: updated at the configuration.
            hessian_F: sum_i H_i F_i (12, 12), N m/rad.
        """
        J = kinematics.J
        # damped, because the plain pseudo-inverse jumps at a straight knee
        N = self._identity - J.T @ np.linalg.solve(J @ J.T + self._damping, J)
        K_q = self._K_0 * N + (J.T * self.K_p) @ J - hessian_F
        B_q = self._B_0 * N + (J.T * self.B_p) @ J
        return JointGains(0.5 * (K_q + K_q.T), 0.5 * (B_q + B_q.T))


STIFFEN_FRACTIONS: Final = (0.25, 0.5, 0.75, 1.0)
"""Steps, as fractions of the way from D to the stiffest allowed D, tried in turn."""


class LocalGains(NamedTuple):
    """Local gains, with which the joint services hold without the planner."""

    D: Array
    """(12,) local stiffness, N m/rad, >= 0."""
    D_B: Array
    """(12,) local damping, N m s/rad, >= 0."""
    margins: Margins
    source: SplitSource


class CouplingGains(NamedTuple):
    """Damping and bandwidth of the planner's coupled torque (`services.planner.law.coupling`)."""

    bandwidth_hz: float
    damping: float
    """c, as a fraction of B_p."""


UNCERTIFIED_COUPLING: Final = CouplingGains(4.0, 1.0)
"""Used with the paper's split, which has no schedule."""


class ScheduledGains:
    """D over COM height and pitch: bilinear between nodes, constant beyond the outer ones."""

    def __init__(self, schedule: GainSchedule) -> None:
        self._z, self._pitch = schedule.z, schedule.pitch
        table = np.array(schedule.D)
        self._table: Array = np.concatenate((table, table), axis=2)
        self.D_B: Array = np.tile(schedule.D_B, 2)
        """(12,) N m s/rad, in every pose."""

    def at(self, z: float, pitch: float) -> Array:
        """Return D (12,), N m/rad, at a COM height (m) and a torso pitch (rad)."""
        i, a = _interval(self._z, z)
        j, b = _interval(self._pitch, pitch)
        shares = np.array(((1.0 - a) * (1.0 - b), (1.0 - a) * b, a * (1.0 - b), a * b))
        D: Array = shares @ self._table[i : i + 2, j : j + 2].reshape(4, N_JOINTS)
        return D


def _interval(nodes: tuple[float, ...], value: float) -> tuple[int, float]:
    """Return the interval's index and the fraction of the way through it, 0 .. 1."""
    i = min(max(bisect_right(nodes, value) - 1, 0), len(nodes) - 2)
    fraction = (value - nodes[i]) / (nodes[i + 1] - nodes[i])
    return i, clamp(fraction, 0.0, 1.0)


class GainSplit:
    """Choice of D and D_B, with their certificate."""

    def __init__(self, config: RobotConfig) -> None:
        """Load the schedule, the limits and the stand gains.

        Raises:
            ConfigError: the split needs a schedule, and the robot's is missing or stale.
        """
        self.certificate = Certificate(config)
        self._schedule: ScheduledGains | None = None
        self.coupling = UNCERTIFIED_COUPLING
        if config.law.split == "certified":
            stale = gain_schedule.why_stale(config)
            if stale or config.gain_schedule is None:
                raise ConfigError("robot", "law.split", stale, "run `xrl gains --config FILE`")
            self._schedule = ScheduledGains(config.gain_schedule)
            schedule = config.gain_schedule
            self.coupling = CouplingGains(schedule.coupling_bandwidth_hz, schedule.coupling_damping)
        limits = config.certificate
        self._margins_min = Margins(limits.margin_min, limits.onboard_margin_min)
        self._k_q_fraction_max = limits.k_q_fraction_max
        self._damping_fraction = config.law.local_damping_fraction
        self._k_max = config.joint_service.k_p_max
        self._d_max = config.joint_service.k_d_max
        stand = [config.stand_gains(module).k_p for module in MODULES]
        self._stand: Array = np.array(stand).ravel()

    def split(
        self,
        body_gains: Callable[[], JointGains],
        z: float,
        pitch: float,
        T: Array,
        hessian_O: Array,
    ) -> LocalGains:
        """Return the local gains at a reference pose.

        Args:
            body_gains: returns K_q and B_q at this pose; called only without a schedule, or if the
                schedule misses the margins.
            z: COM height, m.
            pitch: torso pitch, rad.
            T: joint rates per unit of p along the closed chain (12, 6).
            hessian_O: as in `Certificate.at`.
        """
        certificate = self.certificate
        certificate.at(T, hessian_O)
        schedule = self._schedule
        if schedule is not None:
            D = schedule.at(z, pitch)
            margins = certificate.margins(D)
            if self._meets_margins(margins):
                return LocalGains(D, schedule.D_B, margins, SplitSource.SCHEDULE)
            diagonal, D_B = self._diagonal_gains(body_gains())[0], schedule.D_B
        else:
            diagonal, D_B = self._diagonal_gains(body_gains())
            D, margins = diagonal, certificate.margins(diagonal)
            if self._meets_margins(margins):
                return LocalGains(D, D_B, margins, SplitSource.DIAGONAL)
        D, margins, source = self._stiffen(D, diagonal, margins)
        return LocalGains(D, D_B, margins, source)

    def certify(self, D: Array) -> LocalGains:
        """Return the gains of a controller's own D, with margins at the pose of the last `split`.

        The source is UNCERTIFIED if D misses the margins, is negative or exceeds its limit, or if
        the robot has no schedule.
        """
        D_B = self._schedule.D_B if self._schedule is not None else np.zeros(N_JOINTS)
        margins = self.certificate.margins(D)
        stands = self._schedule is not None and self._meets_margins(margins)
        allowed = bool((D >= 0.0).all() and (self._k_max >= D).all())
        source = SplitSource.CONTROLLER if stands and allowed else SplitSource.UNCERTIFIED
        return LocalGains(D, D_B, margins, source)

    def _diagonal_gains(self, body: JointGains) -> tuple[Array, Array]:
        """Return diag(K_q) and the configured fraction of diag(B_q), each within its limits."""
        D_B = self._damping_fraction * np.diagonal(body.B_q)
        return (
            np.minimum(np.maximum(np.diagonal(body.K_q), 0.0), self._k_max),
            np.minimum(np.maximum(D_B, 0.0), self._d_max),
        )

    def _meets_margins(self, margins: Margins) -> bool:
        minimum = self._margins_min
        return margins.service >= minimum.service and margins.onboard >= minimum.onboard

    def _stiffen(
        self, D: Array, diagonal: Array, margins: Margins
    ) -> tuple[Array, Margins, SplitSource]:
        """Return the first step, from D to the stiffest allowed gains, that meets the margins.

        If no step does, return the stiffest, as UNCERTIFIED.
        """
        stiff = np.maximum(np.maximum(D, self._stand), self._k_q_fraction_max * diagonal)
        stiff = np.minimum(stiff, self._k_max)
        for fraction in STIFFEN_FRACTIONS:
            D_try = D + fraction * (stiff - D)
            margins = self.certificate.margins(D_try)
            if self._meets_margins(margins):
                return D_try, margins, SplitSource.STIFFENED
        return stiff, margins, SplitSource.UNCERTIFIED
