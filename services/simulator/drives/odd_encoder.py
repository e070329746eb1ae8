"""An absolute encoder of which the drive reads no words, or zeros: cycle by cycle.

Firmware 0.5.6 moves the count by the nearest way from the last word to the new one, so that count
and angle always agree within a turn, and a turn that is missing shows in neither. A word of 0
passes the parity: the count goes to the nearest turn of the encoder's own and stays, without an
error. A missing word leaves the count where it is. How many are missing passes a filter of 1 s:
from empty it fails after 51 ms without words, and until then the axis stays armed and blind.
Pure: no clock, no I/O. In counts of the encoder.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

PERIOD_S: Final = 1.0 / 8000.0
"""s of the firmware's control cycle."""
ERROR_RATE_MAX: Final = 0.05
"""Filtered share of missing words beyond which an encoder has failed."""


class Words(Enum):
    """What the drive reads from an encoder."""

    TRUE = 0
    NONE = 1
    ZERO = 2


def nearest(count: int, per_turn: int) -> int:
    """Return a difference of counts by the nearest way: within half a turn."""
    half = per_turn // 2
    return half - (half - count) % per_turn


class OddEncoder:
    """Firmware's state of one encoder.

    Attributes:
        count: `shadow_count`.
        angle: `count_in_cpr`, the last word.
        raw: the encoder's own count, with turns; no drive knows it.
        pos: of the PLL, counts.
        vel: of the PLL, counts/s.
        words: what is read.
        error_rate: filtered share of missing words.
        fails: True if the firmware gave the last cycle up: ABS_SPI_COM_FAIL.
        peak: largest speed of the last run, counts/s.
        is_over: True once it has been read as it is for two runs: it is odd no more.
    """

    def __init__(
        self, raw: int, count: int, pos: float, vel: float, *, per_turn: int, error_rate: float
    ) -> None:
        """Take over an encoder that was read as it is so far."""
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
        """How far the rotor is from where its drive believes it, turns."""
        return nearest(self.raw - self.angle, self._per_turn) / self._per_turn

    def set_count(self, count: int) -> None:
        """Set the count and the estimate; the angle stays."""
        self.count, self.pos = count, float(count)

    def restart(self) -> None:
        """Begin as at power-up: every register is 0."""
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
