"""One axis of firmware 0.5.6 in plain numbers at its own 8 kHz: the reference of the bank.

Read from `Encoder::update` and `Controller::update` (odriverobotics/ODrive): an incremental count
or the words of an absolute encoder, and pass-through inputs.
"""

from __future__ import annotations

import math

PERIOD_S = 1.0 / 8000.0


def clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


class FirmwareAxis:
    """Encoder and controller; the settings by their own names, then the inputs."""

    def __init__(self, turns: float, vel: float, *, counts_per_turn: int) -> None:
        self.counts_per_turn = counts_per_turn
        self.control_mode = 3
        self.pos_gain, self.vel_gain, self.vel_integrator_gain = 20.0, 1.0 / 6.0, 1.0 / 3.0
        self.vel_integrator_limit = math.inf
        self.vel_limit = 2.0
        self.enable_vel_limit = self.enable_torque_mode_vel_limit = True
        self.torque_lim = 0.4
        """current_lim, as the heat leaves it, times torque_constant."""
        self.input_pos = self.input_vel = self.input_torque = 0.0
        self.integrator = 0.0
        self._pos = float(math.floor(turns * counts_per_turn))  # estimates, in counts
        self._vel = vel * counts_per_turn
        self.shadow_count = math.floor(turns * counts_per_turn)
        self.count_in_cpr = self.shadow_count % counts_per_turn
        self.spi_error_rate = 0.0
        self.com_fail = False

    @property
    def pos_estimate(self) -> float:
        return self._pos / self.counts_per_turn

    @property
    def vel_estimate(self) -> float:
        return self._vel / self.counts_per_turn

    def encoder(self, turns: float) -> None:
        """Run the PLL on an incremental count."""
        self._pll(math.floor(turns * self.counts_per_turn))

    def read(self, word: int | None) -> None:
        """Run a cycle on the word of an absolute encoder; None: it has not come."""
        if word is None:
            self.spi_error_rate += PERIOD_S * (1.0 - self.spi_error_rate)
            if self.spi_error_rate > 0.05:
                self.com_fail = True
                return
            word = self.count_in_cpr
        else:
            self.spi_error_rate -= PERIOD_S * self.spi_error_rate
        delta = (word - self.count_in_cpr) % self.counts_per_turn
        if delta > self.counts_per_turn // 2:
            delta -= self.counts_per_turn
        self.shadow_count += delta
        self.count_in_cpr = word
        self._pll(self.shadow_count)

    def _pll(self, count: int) -> None:
        """Estimate at a bandwidth of 1000 1/s, phase detector in whole counts."""
        self._pos += PERIOD_S * self._vel
        error = count - math.floor(self._pos)
        self._pos += PERIOD_S * 2000.0 * error
        self._vel += PERIOD_S * 1e6 * error
        if abs(self._vel) < 0.5 * PERIOD_S * 1e6:
            self._vel = 0.0

    def control(self, pos: float, vel: float) -> float:
        """Return the torque at an estimate, N m, and run the integrator on."""
        limit = self.vel_limit if self.enable_vel_limit else math.inf
        wanted = clamp(self.input_vel, limit)
        torque = clamp(self.input_torque, self.torque_lim)
        if self.control_mode >= 3:
            wanted += self.pos_gain * (self.input_pos - pos)
        error = clamp(wanted, limit) - vel
        if self.control_mode >= 2:
            torque += self.vel_gain * error + self.integrator
        elif self.enable_torque_mode_vel_limit:
            lowest = (-self.vel_limit - vel) * self.vel_gain
            torque = max(lowest, min((self.vel_limit - vel) * self.vel_gain, torque))
        limited = abs(torque) > self.torque_lim
        if self.control_mode < 2:
            self.integrator = 0.0
        elif limited:
            self.integrator *= 0.99
        else:
            self.integrator += self.vel_integrator_gain * PERIOD_S * error
        self.integrator = clamp(self.integrator, self.vel_integrator_limit)
        return clamp(torque, self.torque_lim)
