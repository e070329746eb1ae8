"""Estimators and control law of the emulated axes, as arrays (docs/drives.md).

Firmware 0.5.6, pass-through: torque = input_torque + vel_gain (clamp(input_vel +
pos_gain (input_pos - pos)) - vel) + integrator, clamped to current_lim; input_vel and
input_torque are each clamped to the same limits first. The firmware runs its loop at 8 kHz;
here it is evaluated once a step, with filters discretised exactly for the step's length.

Two effects are left out; neither changes a joint's motion. The firmware's estimate moves in quanta
(one count in position, 0.0076 turn/s in velocity, which snaps to 0 below half of that). The current
follows its setpoint with the current loop's 1 ms; here a step's torque acts at once.

Pure: no clock, no I/O. Arrays are indexed by axis, shape (12,). Units at the motor: turns,
turn/s, N m, A.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.simulator.axis_settings import Settings
from shared.can.cansimple import ControlMode
from shared.robot.joints import N_JOINTS

Vector = NDArray[np.float64]

FIRMWARE_RATE_HZ: Final = 8000.0
INTEGRATOR_DECAY: Final = 0.99
"""Per firmware cycle in which the torque is limited."""


class _LostEncoder(NamedTuple):
    """State of an encoder that has stopped answering."""

    at: int
    """Its count then."""
    said: int | None
    """Its count when it returns; None: its angle within a turn."""
    pos: float
    vel: float
    """The last estimates, turns and turn/s."""


class AxisControl:
    """Inputs, estimates and torque of all axes; no state machine, no errors."""

    def __init__(self, settings: Settings, encoder_counts_per_turn: int) -> None:
        n = N_JOINTS
        self._settings = settings
        self._seen = -1
        self._counts_per_turn = encoder_counts_per_turn
        self.control_mode = settings.axis("controller.config.control_mode")
        self.pos_gain = settings.axis("controller.config.pos_gain")
        self.vel_gain = settings.axis("controller.config.vel_gain")
        self.vel_integrator_gain = settings.axis("controller.config.vel_integrator_gain")
        self.vel_limit = settings.axis("controller.config.vel_limit")
        self.current_lim = settings.axis("motor.config.current_lim")
        self.input_pos = np.zeros(n)
        self.input_vel = np.zeros(n)
        self.input_torque = np.zeros(n)
        self.torque = np.zeros(n)
        self.armed = np.zeros(n)
        """1.0 in closed loop: also the factor of the torque."""
        self.connected = np.zeros(n)
        """1.0 once in closed loop since it started up: from then on the controller sees the
        encoder, in IDLE as well."""
        self.derating = np.ones(n)
        """What heat leaves of current_lim, where `derated`."""
        self.derated = False
        self.integrator = np.zeros(n)
        self._lost: dict[int, _LostEncoder] = {}
        self.counts_from = np.zeros(n)
        """What each encoder's count says at the true zero: whole counts."""
        self._rows = np.zeros((4, n))  # estimates of position and velocity; turns before and now
        self._next = np.zeros((2, n))
        self.pos_estimate: Vector = self._rows[0]
        self.vel_estimate: Vector = self._rows[1]
        self.turns: Vector = self._rows[3]
        """The encoder's whole counts, in turns."""
        self._dt_s = 0.0
        self._decay = 1.0
        self._work, self._high, self._low = np.zeros(n), np.zeros(n), np.zeros(n)
        self._torque_lim, self._torque_min = np.zeros(n), np.zeros(n)
        self._speed = np.zeros(n)

    def start(self, pos_turns: Vector, vel_turns: Vector) -> None:
        """Take over the true state, as after a long time at rest."""
        self._derive()
        self._count(pos_turns)
        self._rows[0] = self._rows[2] = self._rows[3]
        self._rows[1] = vel_turns

    def set_count(self, axis: int, count: float) -> None:
        """Have an axis's encoder read so many counts here, as `set_linear_count` does."""
        if self._seen != self._settings.version:
            self._derive()
        if axis in self._lost:  # the estimates follow when it is back
            self._lost[axis] = self._lost[axis]._replace(said=round(count))
            return
        cpr = self._cpr[axis]
        self.counts_from[axis] += round(count) - self._counted(axis)
        self._rows[2:, axis] = self._rows[0, axis] = round(count) / cpr

    def lose_turns(self, axis: int) -> None:
        """Have an axis's encoder know no more than where it is within a turn, as at power-up."""
        if self._seen != self._settings.version:
            self._derive()
        if axis in self._lost:
            self._lost[axis] = _LostEncoder(0, None, 0.0, 0.0)
            return
        count = self._counted(axis) - round(self.counts_from[axis])
        self.set_count(axis, self._within_a_turn(count))

    def blind(self, axis: int) -> None:
        """Hold an axis's estimates: the firmware goes on reporting the last it had."""
        lost = self._lost.get(axis)
        if lost is None:
            at, (pos, vel) = self._counted(axis), self._rows[:2, axis].tolist()
            self._lost[axis] = lost = _LostEncoder(at, at, pos, vel)
        self._rows[:2, axis] = lost.pos, lost.vel

    def see_again(self, axis: int) -> None:
        """Restart an axis's estimates; turns made meanwhile are not counted."""
        lost = self._lost.pop(axis, None)
        if lost is None:
            return
        if lost.said is None:
            self.lose_turns(axis)
        else:
            moved = self._counted(axis) - lost.at
            self.set_count(axis, lost.said + self._within_a_turn(moved))
        self._rows[1, axis] = 0.0

    def estimate(self, dt_s: float, pos_turns: Vector) -> None:
        """Run the encoders' PLLs over the step, exactly for counts that ramp within it."""
        if self._seen != self._settings.version:
            self._derive()
        if dt_s != self._dt_s:
            self._discretise(dt_s)
        rows = self._rows
        rows[2] = rows[3]
        self._count(pos_turns)
        if self._one_pll:
            np.matmul(self._pll, rows, out=self._next)
        else:
            np.sum(self._plls * rows, axis=1, out=self._next)
        rows[:2] = self._next

    def regulates(self) -> bool:
        """Return True if any axis in closed loop has a position or velocity loop."""
        if self._seen != self._settings.version:
            self._derive()
        return bool(np.dot(self._regulates, self.armed) > 0.0)

    def too_fast(self) -> bool:
        """Return True if any axis is beyond its OVERSPEED limit; `overspeed` says which."""
        np.multiply(self.vel_limit, self._tolerance, out=self._high)
        np.abs(self.vel_estimate, out=self._speed)
        return bool(np.count_nonzero(self._speed > self._high))

    def overspeed(self) -> list[int]:
        """Return the axes beyond their OVERSPEED limit; in IDLE it is checked all the same."""
        return np.flatnonzero((self._speed > self._high) * self.connected).tolist()

    def stay(self, axis: int) -> None:
        """Make where the motor is its target, in position mode: `control_mode_updated`."""
        if self.control_mode[axis] >= ControlMode.POSITION:
            self.input_pos[axis] = self.pos_estimate[axis]

    def arm(self, axis: int) -> None:
        """Let an axis's torque through, from where it is; `input_torque` stays as it stands."""
        self.stay(axis)
        self.integrator[axis] = 0.0
        self.armed[axis] = self.connected[axis] = 1.0

    def control(self) -> None:
        """Write the firmware's law to `torque`, zero where an axis is not in closed loop."""
        if self._seen != self._settings.version:
            self._derive()
        torque, limit, low = self.torque, self._torque_lim, self._torque_min
        np.multiply(self.current_lim, self._torque_constant, out=limit)
        if self.derated:
            limit *= self.derating
        np.negative(limit, out=low)
        np.minimum(self.input_torque, limit, out=torque)
        np.maximum(torque, low, out=torque)
        if self._any_torque_limited:
            self._limit_torque_mode()
        if self._any_regulates:
            self._regulate()
        np.minimum(torque, limit, out=torque)
        np.maximum(torque, low, out=torque)
        torque *= self.armed

    def _counted(self, axis: int) -> int:
        """Return an axis's encoder's count."""
        return round(float(self._rows[3, axis] * self._cpr[axis]))

    def _within_a_turn(self, count: int) -> int:
        """Return the count that an absolute encoder, which knows no turns, is taken to be at."""
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
        """Work out what follows from the settings."""
        axis = self._settings.axis
        self._seen = self._settings.version
        self._torque_constant = axis("motor.config.torque_constant").copy()
        self._cpr = axis("encoder.config.cpr").copy()
        self._bandwidth = axis("encoder.config.bandwidth").copy()
        self._one_pll = bool((self._bandwidth == self._bandwidth[0]).all())
        self._dt_s = 0.0
        mode = self.control_mode
        self._regulates = (mode >= ControlMode.VELOCITY).astype(np.float64)
        self._positions = (mode >= ControlMode.POSITION).astype(np.float64)
        self._any_regulates = bool(self._regulates.any())
        self._all_regulate = bool(self._regulates.all())
        self._all_position = bool(self._positions.all())
        limited = axis("controller.config.enable_torque_mode_vel_limit") > 0.0
        self._torque_limited = limited & (self._regulates == 0.0)
        self._any_torque_limited = bool(self._torque_limited.any())
        self._all_torque_limited = bool(self._torque_limited.all())
        self.integrator *= self._regulates  # the firmware empties it in torque mode
        checked = axis("controller.config.enable_overspeed_error") > 0.0
        tolerance = axis("controller.config.vel_limit_tolerance")
        self._tolerance = np.where(checked, tolerance, math.inf)
        clamped = axis("controller.config.enable_vel_limit") > 0.0
        self._vel_clamp = self.vel_limit if clamped.all() else np.where(clamped, self.vel_limit, 0)
        if not clamped.all():
            self._vel_clamp[~clamped] = math.inf
        self._integrator_limit = axis("controller.config.vel_integrator_limit").copy()

    def _discretise(self, dt_s: float) -> None:
        """Compute the PLLs' transition over a step.

        With s = (count now - count before) / dt the errors e = (count - position,
        s - velocity) follow e' = [[-2w, 1], [-w^2, 0]] e, a double pole at the bandwidth w.
        """
        self._dt_s = dt_s
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
        self._decay = INTEGRATOR_DECAY ** (FIRMWARE_RATE_HZ * dt_s)

    def _limit_torque_mode(self) -> None:
        """Let no axis in torque mode be driven beyond its velocity limit.

        The firmware clamps to vel_gain (+-vel_limit - vel).
        """
        limited, high, low = self._work, self._high, self._low
        np.subtract(self.vel_limit, self.vel_estimate, out=high)
        high *= self.vel_gain
        np.add(self.vel_limit, self.vel_estimate, out=low)
        low *= self.vel_gain
        np.negative(low, out=low)
        np.minimum(self.torque, high, out=limited)
        np.maximum(limited, low, out=limited)
        if self._all_torque_limited:
            self.torque[:] = limited
        else:
            np.copyto(self.torque, limited, where=self._torque_limited)

    def _regulate(self) -> None:
        """Add the velocity loop, under it the position loop, where the mode has them."""
        v_err, high, low = self._work, self._high, self._low
        np.subtract(self.input_pos, self.pos_estimate, out=v_err)
        v_err *= self.pos_gain
        if not self._all_position:
            v_err *= self._positions
        np.negative(self._vel_clamp, out=low)
        np.minimum(self.input_vel, self._vel_clamp, out=high)
        np.maximum(high, low, out=high)
        v_err += high
        np.minimum(v_err, self._vel_clamp, out=v_err)
        np.maximum(v_err, low, out=v_err)
        v_err -= self.vel_estimate
        if not self._all_regulate:
            v_err *= self._regulates
        np.multiply(v_err, self.vel_gain, out=low)
        self.torque += low
        if np.count_nonzero(self.vel_integrator_gain) or np.count_nonzero(self.integrator):
            self._integrate(v_err)

    def _integrate(self, v_err: Vector) -> None:
        """Add the integrator to the torque and run it on; it decays where that is limited."""
        self.torque += self.integrator
        limited = np.abs(self.torque) > self._torque_lim
        v_err *= self.vel_integrator_gain
        v_err *= self._dt_s
        v_err *= self.armed
        if limited.any():
            self.integrator[limited] *= self._decay
            v_err[limited] = 0.0
        self.integrator += v_err
        np.minimum(self.integrator, self._integrator_limit, out=self.integrator)
        np.maximum(self.integrator, -self._integrator_limit, out=self.integrator)
