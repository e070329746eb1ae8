"""Encoders and velocity estimators of the emulated axes, as arrays (docs/drives.md).

Firmware 0.5.6: a PLL estimates position and velocity from the encoder's whole counts. The firmware
runs it at 8 kHz; here it is evaluated once a step, discretised exactly for the step's length. The
firmware's estimate moves in quanta (one count in position, 0.0076 turn/s in velocity, which snaps
to 0 below half of that); that is left out, because it changes no joint's motion. Pure: no clock, no
I/O. Arrays are indexed by axis, shape (12,). Units at the motor: turns, turn/s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_settings import Settings
from shared.joints import N_JOINTS

Vector = NDArray[np.float64]


class _LostEncoder(NamedTuple):
    """State of an encoder that has stopped answering."""

    at: int
    """Its count then."""
    said: int | None
    """Its count when it returns; None: its angle within a turn."""
    pos: float
    vel: float
    """The last estimates, turns and turn/s."""


class AxisEncoders:
    """Counts and estimates of all axes.

    Attributes:
        counts_from: each encoder's count at the true zero, a whole number.
        pos_estimate: turns.
        vel_estimate: turn/s.
        turns: the encoders' whole counts, in turns.
        dt_s: length of the last step; 0 before the first and after a change of settings.
    """

    def __init__(self, settings: Settings, counts_per_turn: int) -> None:
        """Take the settings, and the counts of the encoders themselves."""
        self._settings = settings
        self._seen = -1
        self._counts_per_turn = counts_per_turn
        self._lost: dict[int, _LostEncoder] = {}
        self.counts_from = np.zeros(N_JOINTS)
        self._rows = np.zeros((4, N_JOINTS))  # estimated position and velocity; turns before, now
        self._next = np.zeros((2, N_JOINTS))
        self.pos_estimate: Vector = self._rows[0]
        self.vel_estimate: Vector = self._rows[1]
        self.turns: Vector = self._rows[3]
        self.dt_s = 0.0

    def start(self, pos_turns: Vector, vel_turns: Vector) -> None:
        """Take over the true state, as after a long time at rest."""
        self._derive()
        self._count(pos_turns)
        self._rows[0] = self._rows[2] = self._rows[3]
        self._rows[1] = vel_turns

    def set_count(self, axis: int, count: float) -> None:
        """Set an axis's encoder to a count at its present place, as `set_linear_count` does."""
        if self._seen != self._settings.version:
            self._derive()
        if axis in self._lost:  # the estimates follow when it is back
            self._lost[axis] = self._lost[axis]._replace(said=round(count))
            return
        cpr = self._cpr[axis]
        self.counts_from[axis] += round(count) - self._counted(axis)
        self._rows[2:, axis] = self._rows[0, axis] = round(count) / cpr

    def forget_turns(self, axis: int) -> None:
        """Make an axis's encoder know its angle within a turn only, as at power-up."""
        if self._seen != self._settings.version:
            self._derive()
        if axis in self._lost:
            self._lost[axis] = _LostEncoder(0, None, 0.0, 0.0)
            return
        count = self._counted(axis) - round(self.counts_from[axis])
        self.set_count(axis, self._within_a_turn(count))

    def freeze(self, axis: int) -> None:
        """Hold an axis's estimates: the firmware keeps reporting the last ones."""
        lost = self._lost.get(axis)
        if lost is None:
            at, (pos, vel) = self._counted(axis), self._rows[:2, axis].tolist()
            self._lost[axis] = lost = _LostEncoder(at, at, pos, vel)
        self._rows[:2, axis] = lost.pos, lost.vel

    def recover(self, axis: int) -> None:
        """Restart an axis's estimates; turns made meanwhile are not counted."""
        lost = self._lost.pop(axis, None)
        if lost is None:
            return
        if lost.said is None:
            self.forget_turns(axis)
        else:
            moved = self._counted(axis) - lost.at
            self.set_count(axis, lost.said + self._within_a_turn(moved))
        self._rows[1, axis] = 0.0

    def estimate(self, dt_s: float, pos_turns: Vector) -> None:
        """Run the encoders' PLLs over the step, exactly for counts that ramp within it."""
        if self._seen != self._settings.version:
            self._derive()
        if dt_s != self.dt_s:
            self._discretise(dt_s)
        rows = self._rows
        rows[2] = rows[3]
        self._count(pos_turns)
        if self._one_pll:
            np.matmul(self._pll, rows, out=self._next)
        else:
            np.sum(self._plls * rows, axis=1, out=self._next)
        rows[:2] = self._next

    def _counted(self, axis: int) -> int:
        """Return an axis's encoder's count."""
        return round(float(self._rows[3, axis] * self._cpr[axis]))

    def _within_a_turn(self, count: int) -> int:
        """Return the count within half a turn of zero: an absolute encoder counts no turns."""
        half = self._counts_per_turn // 2
        return half - (half - count) % self._counts_per_turn

    def _count(self, pos_turns: Vector) -> None:
        """Write the encoder's whole counts, in turns as the setting `cpr` has them."""
        counts = self._rows[3]
        np.multiply(pos_turns, self._counts_per_turn, out=counts)
        np.floor(counts, out=counts)
        counts += self.counts_from
        counts /= self._cpr

    def _derive(self) -> None:
        """Compute what follows from the settings."""
        self._seen = self._settings.version
        self._cpr = self._settings.axis("encoder.config.cpr").copy()
        self._bandwidth = self._settings.axis("encoder.config.bandwidth").copy()
        self._one_pll = bool((self._bandwidth == self._bandwidth[0]).all())
        self.dt_s = 0.0

    def _discretise(self, dt_s: float) -> None:
        """Compute the PLLs' transition over a step.

        With s = (count now - count before) / dt the errors e = (count - position,
        s - velocity) follow e' = [[-2w, 1], [-w^2, 0]] e, a double pole at the bandwidth w.
        """
        self.dt_s = dt_s
        w = self._bandwidth
        wt = w * dt_s
        fade = np.exp(-wt)
        p00, p01 = fade * (1.0 - wt), fade * dt_s
        p10, p11 = fade * -wt * w, fade * (1.0 + wt)
        self._plls = np.array(
            [
                [p00, p01, p01 / dt_s - p00, 1.0 - p01 / dt_s],
                [p10, p11, -p10 - (1.0 - p11) / dt_s, (1.0 - p11) / dt_s],
            ]
        )
        self._pll = self._plls[:, :, 0].copy()
