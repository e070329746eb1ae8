"""A bank of emulated drives stepped at a millisecond, free rotors, and the firmware's own axis."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_bank import AxisBank
from shared.can.cansimple import AxisState, ControlMode, InputMode
from shared.config.sections import DriveConfig

KT = 0.0827
"""N m/A"""
DRIVE = DriveConfig(
    encoder_bandwidth=1000.0,  # rad/s: at a step of 1 ms the emulation is exact to a few per cent
    torque_constant=KT,
    current_lim=60.0,
    vel_limit=60.0,
    dc_max_negative_current=-30.0,
    watchdog_timeout=0.1,
    encoder_period_ms=1,
    heartbeat_period_ms=100,
    zero_mark_turns=0.0,
)
CPR = 16384
DT = 0.001
ZERO = np.zeros(12)
IDLE, CLOSED_LOOP = AxisState.IDLE, AxisState.CLOSED_LOOP_CONTROL


def only(axis: int, value: float) -> NDArray[np.float64]:
    """Return a row of twelve in which one axis has a value, and the others zero."""
    row = ZERO.copy()
    row[axis] = value
    return row


def idle_bank(turns: NDArray[np.float64] = ZERO, mark: float = 0.0, **options: Any) -> AxisBank:
    """Return a bank in IDLE at a position, at time 0."""
    drive = msgspec.structs.replace(DRIVE, zero_mark_turns=mark)
    bank = AxisBank(drive, encoder_counts_per_turn=CPR, **options)
    bank.step(0.0, turns, ZERO)
    return bank


def close_loop(bank: AxisBank, mode: ControlMode, axes: range = range(12)) -> None:
    """Set a mode and request closed loop."""
    for axis in axes:
        bank.set_modes(axis, mode, InputMode.PASSTHROUGH)
        bank.request_state(axis, CLOSED_LOOP)


def make_bank(
    mode: ControlMode = ControlMode.TORQUE,
    *,
    watchdog: bool = False,
    turns: float = 0.0,
    torque: float = 0.0,
) -> AxisBank:
    """Return a bank with all axes in closed loop at a position and an input torque, at time 0."""
    bank = idle_bank(ZERO + turns, watchdog=watchdog)
    close_loop(bank, mode)
    assert bank.state == [CLOSED_LOOP] * 12
    bank.input_torque[:] = torque
    return bank


def step_for(
    bank: AxisBank,
    seconds: float,
    pos: NDArray[np.float64] = ZERO,
    vel: NDArray[np.float64] = ZERO,
) -> NDArray[np.float64]:
    """Step the bank on, moving at `vel` from `pos`; return the last torque."""
    start_s, torque = bank.now_s, ZERO
    for k in range(1, round(seconds / DT) + 1):
        torque = bank.step(start_s + k * DT, pos + vel * k * DT, vel).copy()
    return torque


class FreeRotors:
    """Twelve rotors that a bank turns, or its field; nothing hangs on them.

    Attributes:
        pos: positions (12,), turns.
        load: torque against each, N m per turn from the start.
        blocked: axes that do not turn.
        farthest: largest distance of each from its start (12,), turns.
    """

    INERTIA = 2.5e-4
    """kg m^2"""
    FRICTION = 2e-3
    """N m s/rad"""

    def __init__(self, bank: AxisBank, pos: NDArray[np.float64], dt_s: float = DT) -> None:
        self.bank, self._start, self._dt_s = bank, pos.copy(), dt_s
        self.pos, self._vel, self.load, self.farthest = pos.copy(), *np.zeros((3, 12))
        self.blocked: set[int] = set()

    def run(self, seconds: float) -> None:
        """Step for a time."""
        dt_s = self._dt_s
        fade = 1.0 + self.FRICTION / self.INERTIA * dt_s
        gain = dt_s / (2.0 * np.pi * self.INERTIA)
        for _ in range(round(seconds / dt_s)):
            torque = self.bank.step(self.bank.now_s + dt_s, self.pos, self._vel)
            away = self.pos - self._start
            self._vel = (self._vel + gain * (torque - self.load * away)) / fade
            self._vel[list(self.blocked)] = 0.0
            self.pos = self.pos + dt_s * self._vel
            np.maximum(self.farthest, np.abs(away), out=self.farthest)


PERIOD_S = 1.0 / 8000.0


def limited(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


class FirmwareAxis:
    """One axis of firmware 0.5.6 in plain numbers at its own 8 kHz: the reference of the bank.

    Read from `Encoder::update` and `Controller::update` (odriverobotics/ODrive): an incremental
    count or the words of an absolute encoder, and pass-through inputs. The settings have their own
    names.
    """

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
        wanted = limited(self.input_vel, limit)
        torque = limited(self.input_torque, self.torque_lim)
        if self.control_mode >= 3:
            wanted += self.pos_gain * (self.input_pos - pos)
        error = limited(wanted, limit) - vel
        if self.control_mode >= 2:
            torque += self.vel_gain * error + self.integrator
        elif self.enable_torque_mode_vel_limit:
            lowest = (-self.vel_limit - vel) * self.vel_gain
            torque = max(lowest, min((self.vel_limit - vel) * self.vel_gain, torque))
        is_limited = abs(torque) > self.torque_lim
        if self.control_mode < 2:
            self.integrator = 0.0
        elif is_limited:
            self.integrator *= 0.99
        else:
            self.integrator += self.vel_integrator_gain * PERIOD_S * error
        self.integrator = limited(self.integrator, self.vel_integrator_limit)
        return limited(torque, self.torque_lim)
