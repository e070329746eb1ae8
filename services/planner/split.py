"""The gain split: what of K_q and B_q the joint services hold alone (design section 3 c).

`certified` takes D from the schedule made offline, `diagonal` is the paper's diag(K_q).
Either way no gains leave without their certificate: where the margin is not met, D is
stiffened towards gains that stand, and if none of these does either, the split says so
and the robot is to hold. Pure.
"""

from __future__ import annotations

from bisect import bisect_right
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.planner.certificate import Certificate, Margins
from shared import gain_schedule
from shared.config import RobotConfig
from shared.config_sections import GainSchedule
from shared.exceptions import ConfigError
from shared.joints import MODULES
from shared.messages import SplitSource

Array = NDArray[np.float64]

STIFFEN: Final = (0.25, 0.5, 0.75, 1.0)
"""Shares of the way from the wanted D to the stiff one, tried in turn."""


class LocalGains(NamedTuple):
    """What the joint services hold alone."""

    D: Array
    """(12,) local stiffness, N m/rad, >= 0."""
    D_B: Array
    """(12,) local damping, N m s/rad, >= 0."""
    margins: Margins
    source: SplitSource


class ScheduledGains:
    """D over COM height and pitch: bilinear between nodes, held beyond the last."""

    def __init__(self, schedule: GainSchedule) -> None:
        """Take the table."""
        self._z, self._pitch = schedule.z, schedule.pitch
        table = np.array(schedule.D)
        self._table: Array = np.concatenate((table, table), axis=2)

    def at(self, z: float, pitch: float) -> Array:
        """Return D (12,), N m/rad, at a COM height (m) and a torso pitch (rad)."""
        i, a = _between(self._z, z)
        j, b = _between(self._pitch, pitch)
        low, high = self._table[i], self._table[i + 1]
        return np.asarray(
            (1.0 - a) * ((1.0 - b) * low[j] + b * low[j + 1])
            + a * ((1.0 - b) * high[j] + b * high[j + 1]),
            float,
        )


def _between(nodes: tuple[float, ...], value: float) -> tuple[int, float]:
    """Return the interval's index and the share of the way through it, 0 .. 1."""
    i = min(max(bisect_right(nodes, value) - 1, 0), len(nodes) - 2)
    share = (value - nodes[i]) / (nodes[i + 1] - nodes[i])
    return i, min(1.0, max(0.0, share))


class GainSplit:
    """Chooses D and D_B and certifies them."""

    def __init__(self, config: RobotConfig) -> None:
        """Take the schedule, the limits and the stiff gains to fall back on.

        Raises:
            ConfigError: the split needs a schedule, and the robot's is missing or stale.
        """
        self.certificate = Certificate(config)
        self._schedule: ScheduledGains | None = None
        if config.law.split == "certified":
            stale = gain_schedule.why_stale(config)
            if stale or config.gain_schedule is None:
                raise ConfigError("robot", "law.split", stale, "run `xrl gains --config FILE`")
            self._schedule = ScheduledGains(config.gain_schedule)
        limits = config.certificate
        self._margins_min = Margins(limits.margin_min, limits.onboard_margin_min)
        self._k_q_share_max = limits.k_q_share_max
        self._damping_share = config.law.local_damping_share
        self._k_max = config.joint_service.k_p_max
        self._d_max = config.joint_service.k_d_max
        stand = [config.stand_gains(module).k_p for module in MODULES]
        self._stand: Array = np.array(stand).ravel()

    def split(
        self, K_q: Array, B_q: Array, z: float, pitch: float, T: Array, hessian_O: Array
    ) -> LocalGains:
        """Return the local gains at a reference pose.

        Args:
            K_q: whole-body stiffness (12, 12), N m/rad.
            B_q: whole-body damping (12, 12), N m s/rad.
            z: COM height, m.
            pitch: of the torso, rad.
            T: joint rates per unit of p along the closed chain (12, 6).
            hessian_O: as for `Certificate.at`.
        """
        certificate = self.certificate
        certificate.at(T, hessian_O)
        diagonal = np.minimum(np.maximum(np.diagonal(K_q), 0.0), self._k_max)
        D = diagonal if self._schedule is None else self._schedule.at(z, pitch)
        margins = certificate.margins(D)
        source = SplitSource.DIAGONAL if self._schedule is None else SplitSource.SCHEDULE
        if not self._enough(margins):
            D, margins, source = self._stiffened(D, diagonal, margins)
        # damping as the stiffness: what K_q gives up to tau_coupled, B_q gives up too
        share = self._damping_share * D / np.maximum(diagonal, 1.0)
        share = np.minimum(share, self._k_q_share_max * self._damping_share)
        D_B = np.minimum(np.maximum(share * np.diagonal(B_q), 0.0), self._d_max)
        return LocalGains(D, D_B, margins, source)

    def _enough(self, margins: Margins) -> bool:
        least = self._margins_min
        return margins.service >= least.service and margins.onboard >= least.onboard

    def _stiffened(
        self, D: Array, diagonal: Array, margins: Margins
    ) -> tuple[Array, Margins, SplitSource]:
        """Return the nearest certified gains on the way to the stiffest that are allowed."""
        stiff = np.maximum(np.maximum(D, self._stand), self._k_q_share_max * diagonal)
        stiff = np.minimum(stiff, self._k_max)
        for share in STIFFEN:
            D_near = D + share * (stiff - D)
            margins = self.certificate.margins(D_near)
            if self._enough(margins):
                return D_near, margins, SplitSource.STIFFENED
        return stiff, margins, SplitSource.UNCERTIFIED
