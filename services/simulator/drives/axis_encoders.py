"""Encoders and velocity estimators of the emulated axes, as arrays (docs/drives.md).

In firmware 0.5.6, a PLL estimates position and velocity from the encoder's whole counts, at 8 kHz.
The emulation evaluates it once per step, discretised exactly for the step's length. The firmware's
estimate moves in quanta (one count in position, 0.0076 turn/s in velocity, which snaps to 0 below
half of that). The emulation omits them, because they change no joint's motion. An axis that reads
no words from its encoder, or wrong words, runs cycle by cycle (`OddEncoder`). Pure: no clock, no
I/O. Arrays are indexed by axis, shape (12,). Units at the motor: turns, turn/s.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_settings import Settings
from shared.joints import N_JOINTS

Vector = NDArray[np.float64]

_SPREAD: Final = 0.6180339887498949
"""Angle between the magnets of successive encoders, turns; no two mounting angles are equal."""


PERIOD_S: Final = 1.0 / 8000.0
"""Period of the firmware's control cycle, s."""
ERROR_RATE_MAX: Final = 0.05
"""Filtered share of missing words beyond which an encoder has failed."""


class Words(Enum):
    """Words that the drive reads from an encoder."""

    TRUE = 0
    NONE = 1
    ZERO = 2


def nearest(count: int, per_turn: int) -> int:
    """Return a difference of counts, wrapped to within half a turn."""
    half = per_turn // 2
    return half - (half - count) % per_turn


class OddEncoder:
    """The firmware's state for an absolute encoder from which it reads no words, or zeros.

    Firmware 0.5.6 moves the count by the wrapped difference between the last word and the new word.
    Count and angle thus always agree within a turn, and neither shows a missing turn. A word of 0
    passes the parity check: the count moves to the encoder's nearest whole turn and stays there,
    without an error. A missing word leaves the count unchanged. The share of missing words passes a
    low-pass of 1 s. From zero, it exceeds the limit after 51 ms without words, and the encoder
    fails; until then the axis stays armed. Units are counts of the encoder.

    Attributes:
        count: `shadow_count`.
        angle: `count_in_cpr`, the last word.
        raw: the encoder's own count, with turns; unknown to the drive.
        pos: position of the PLL, counts.
        vel: velocity of the PLL, counts/s.
        words: words that the drive reads.
        error_rate: filtered share of missing words.
        fails: True if the firmware aborted the last cycle: ABS_SPI_COM_FAIL.
        peak: largest speed of the last run, counts/s.
        is_over: True once two runs have read true words, so the encoder is no longer odd.
    """

    def __init__(
        self, raw: int, count: int, pos: float, vel: float, *, per_turn: int, error_rate: float
    ) -> None:
        """Continue from an encoder that has sent true words."""
        self._per_turn = per_turn
        self.count, self.raw = count, raw
        self.angle = raw % per_turn
        self.pos, self.vel = pos, vel
        self.words = Words.TRUE
        self.error_rate = error_rate
        self.fails = False
        self.peak = 0.0
        self.is_over = self._is_back = False

    @property
    def off_phase(self) -> float:
        """Offset of the rotor from the angle that its drive assumes, turns."""
        return nearest(self.raw - self.angle, self._per_turn) / self._per_turn

    def set_count(self, count: int) -> None:
        """Set the count and the estimate; the angle stays."""
        self.count, self.pos = count, float(count)

    def restart(self) -> None:
        """Set every register to 0, as at power-up."""
        self.count = self.angle = 0
        self.pos = self.vel = self.error_rate = 0.0
        self.fails = False

    def run(self, dt_s: float, raw: int, bandwidth: float) -> None:
        """Run the firmware's cycles of a step in which the encoder moved to `raw`."""
        cycles = max(1, round(dt_s / PERIOD_S))
        period_s = dt_s / cycles
        moved, was = raw - self.raw, self.raw
        is_true = self.words is Words.TRUE
        self.is_over, self._is_back = is_true and self._is_back, is_true
        self.raw, self.peak = raw, 0.0
        for k in range(1, cycles + 1):
            missing = self.words is Words.NONE
            self.error_rate += period_s * (missing - self.error_rate)
            self.fails = missing and self.error_rate > ERROR_RATE_MAX
            if self.fails:
                continue
            if not missing:
                word = (was + moved * k // cycles) % self._per_turn
                self._read(0 if self.words is Words.ZERO else word)
            self.pos += period_s * self.vel
            error = self.count - self.pos
            self.pos += period_s * 2.0 * bandwidth * error
            self.vel += period_s * bandwidth * bandwidth * error
            self.peak = max(self.peak, abs(self.vel))

    def _read(self, word: int) -> None:
        self.count += nearest(word - self.angle, self._per_turn)
        self.angle = word


class AxisEncoders:
    """Counts and estimates of all axes.

    Attributes:
        counts_from: each drive's count at the true zero, a whole number.
        mount: each encoder's own count at the true zero, within a turn; it depends on how its
            magnet is mounted. It may be written before the first step.
        pos_estimate: turns.
        vel_estimate: turn/s.
        turns: the drives' whole counts, in turns.
        odd: encoders without true words, by axis.
        dt_s: length of the last step; 0 before the first and after a change of settings.
    """

    def __init__(self, settings: Settings, counts_per_turn: int) -> None:
        """Bind the settings, and set the encoders' counts per turn."""
        self._settings = settings
        self._seen = -1
        self._counts_per_turn = counts_per_turn
        self.odd: dict[int, OddEncoder] = {}
        self._error_rates: dict[int, tuple[float, float]] = {}  # last value, and its time
        self._clock_s = 0.0
        self.counts_from = np.zeros(N_JOINTS)
        self.mount = np.floor(np.arange(1, N_JOINTS + 1) * _SPREAD % 1.0 * counts_per_turn)
        self._rows = np.zeros((4, N_JOINTS))  # estimated position and velocity; turns before, now
        self._next = np.zeros((2, N_JOINTS))
        self.pos_estimate: Vector = self._rows[0]
        self.vel_estimate: Vector = self._rows[1]
        self.turns: Vector = self._rows[3]
        self.dt_s = 0.0

    def start(self, pos_turns: Vector, vel_turns: Vector) -> None:
        """Start from the true state, as after a long time at rest."""
        self._derive()
        self._count(pos_turns)
        self._rows[0] = self._rows[2] = self._rows[3]
        self._rows[1] = vel_turns

    def set_count(self, axis: int, count: float) -> None:
        """Set an axis's count at its present position, like `set_linear_count`; the angle stays."""
        if self._seen != self._settings.version:
            self._derive()
        odd = self.odd.get(axis)
        if odd is not None:
            odd.set_count(round(count))
            self._rows[2:, axis] = odd.count / self._cpr[axis]
            return
        self.counts_from[axis] += round(count) - self.counted(axis)
        self._rows[2:, axis] = self._rows[0, axis] = round(count) / self._cpr[axis]

    def forget_turns(self, axis: int) -> None:
        """Reduce an axis's count to the angle within a turn, as at power-up."""
        odd = self.odd.get(axis)
        self.clear_errors(axis)
        if odd is not None:
            odd.restart()
            self._rows[:, axis] = 0.0
            return
        self.set_count(axis, nearest(self.angle(axis), self._counts_per_turn))

    def angle(self, axis: int) -> int:
        """Return an axis's `count_in_cpr`: its encoder's own count within a turn, as last read."""
        if self._seen != self._settings.version:
            self._derive()
        odd = self.odd.get(axis)
        return odd.angle if odd is not None else self._raw(axis) % self._counts_per_turn

    def counted(self, axis: int) -> int:
        """Return an axis's `shadow_count`."""
        if self._seen != self._settings.version:
            self._derive()
        return round(float(self._rows[3, axis] * self._cpr[axis]))

    def wrap_turns(self, axis: int) -> None:
        """Set an axis's count to its angle in the turn, as the encoder's calibration does."""
        self.set_count(axis, self.angle(axis))

    def read_words(self, axis: int, words: Words) -> None:
        """Set the words that an axis reads from its encoder."""
        if self._seen != self._settings.version:
            self._derive()
        odd = self.odd.get(axis)
        if odd is None:
            rate, then_s = self._error_rates.pop(axis, (0.0, 0.0))
            pos, vel = (self._rows[:2, axis] * self._cpr[axis]).tolist()
            self.odd[axis] = odd = OddEncoder(
                self._raw(axis),
                self.counted(axis),
                pos,
                vel,
                per_turn=self._counts_per_turn,
                error_rate=rate * math.exp(then_s - self._clock_s),
            )
        odd.words = words

    def clear_errors(self, axis: int) -> None:
        """Reset the filter of an axis's missing words, as the firmware's `clear_errors` does."""
        self._error_rates.pop(axis, None)
        if axis in self.odd:
            self.odd[axis].error_rate = 0.0

    def estimate(self, dt_s: float, pos_turns: Vector) -> None:
        """Run the encoders' PLLs over the step; exact for counts that ramp within it."""
        if self._seen != self._settings.version:
            self._derive()
        if dt_s != self.dt_s:
            self._discretise(dt_s)
        self._clock_s += dt_s
        rows = self._rows
        rows[2] = rows[3]
        self._count(pos_turns)
        if self._one_pll:
            np.matmul(self._pll, rows, out=self._next)
        else:
            np.sum(self._plls * rows, axis=1, out=self._next)
        if self.odd:
            self._run_odd(dt_s)
        rows[:2] = self._next

    def overspeed(self) -> list[int]:
        """Return the odd axes whose estimate was beyond the OVERSPEED limit within the step."""
        column = self._settings.axis
        checked = column("controller.config.enable_overspeed_error")
        limits = column("controller.config.vel_limit") * column(
            "controller.config.vel_limit_tolerance"
        )
        return [
            axis
            for axis, odd in self.odd.items()
            if checked[axis] and odd.peak > limits[axis] * self._cpr[axis]
        ]

    def commutate(self, torque: Vector) -> None:
        """Scale the odd axes' torques, because their rotors have moved since the last word."""
        poles = self._settings.axis("motor.config.pole_pairs")
        for axis, odd in self.odd.items():
            torque[axis] *= math.cos(2.0 * math.pi * poles[axis] * odd.off_phase)

    def _run_odd(self, dt_s: float) -> None:
        """Run the odd encoders over the step, in place of their PLLs."""
        for axis, odd in list(self.odd.items()):
            raw, cpr = self._raw(axis), self._cpr[axis]
            odd.run(dt_s, raw, float(self._bandwidth[axis]))
            self._rows[3, axis] = odd.count / cpr
            if odd.fails:  # the last estimate stays
                self._next[:, axis] = self._rows[:2, axis]
                continue
            self._next[:, axis] = odd.pos / cpr, odd.vel / cpr
            if odd.is_over:
                self.counts_from[axis] = odd.count - raw + round(self.mount[axis])
                self._error_rates[axis] = odd.error_rate, self._clock_s
                del self.odd[axis]

    def _raw(self, axis: int) -> int:
        """Return an encoder's own count, with turns; for an odd encoder only after `_count`."""
        return self.counted(axis) - round(float(self.counts_from[axis] - self.mount[axis]))

    def _count(self, pos_turns: Vector) -> None:
        """Write the encoders' whole counts, in turns of the setting `cpr`."""
        counts = self._rows[3]
        np.multiply(pos_turns, self._counts_per_turn, out=counts)
        np.floor(counts, out=counts)
        counts += self.counts_from
        counts /= self._cpr

    def _derive(self) -> None:
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
