"""An emulated bank of drives for tests, stepped at a millisecond."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from services.simulator.drives.axis_bank import AxisBank
from shared.can.cansimple import AxisState, ControlMode, InputMode
from shared.config.sections import DriveConfig

DRIVE = DriveConfig(
    encoder_bandwidth=1000.0,  # rad/s: at a step of 1 ms the emulation is exact to a few per cent
    torque_constant=0.0827,
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


def idle_bank(turns: NDArray[np.float64] = ZERO, mark: float = 0.0, **options: Any) -> AxisBank:
    """Return a bank in IDLE at a position, at time 0."""
    drive = msgspec.structs.replace(DRIVE, zero_mark_turns=mark)
    bank = AxisBank(drive, encoder_counts_per_turn=CPR, **options)
    bank.step(0.0, turns, ZERO)
    return bank


def close_loop(bank: AxisBank, mode: ControlMode, axes: range = range(12)) -> None:
    """Set a mode and ask for closed loop."""
    for axis in axes:
        bank.set_modes(axis, mode, InputMode.PASSTHROUGH)
        bank.request_state(axis, CLOSED_LOOP)


def make_bank(
    mode: ControlMode = ControlMode.TORQUE, *, watchdog: bool = False, turns: float = 0.0
) -> AxisBank:
    """Return a bank with all axes in closed loop at a position, at time 0."""
    bank = idle_bank(ZERO + turns, watchdog=watchdog)
    close_loop(bank, mode)
    assert bank.state == [CLOSED_LOOP] * 12
    return bank


class FreeRotors:
    """Twelve rotors that a bank turns, or its field; nothing hangs on them.

    Attributes:
        pos: where they are (12,), turns.
        load: torque against each, N m per turn from where it was at the start.
        blocked: axes that do not turn.
        farthest: from where each was at the start (12,), turns.
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
        """Let time pass, a step after the other."""
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


def step_for(
    bank: AxisBank,
    seconds: float,
    pos: NDArray[np.float64] = ZERO,
    vel: NDArray[np.float64] = ZERO,
) -> NDArray[np.float64]:
    """Step the bank on, moving at `vel` from `pos`; return the last torque."""
    start_s = bank.now_s
    torque = ZERO
    for k in range(1, round(seconds / DT) + 1):
        torque = bank.step(start_s + k * DT, pos + vel * k * DT, vel).copy()
    return torque
