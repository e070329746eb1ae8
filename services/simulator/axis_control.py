"""Control law of the emulated axes, as arrays (docs/drives.md).

Firmware 0.5.6, pass-through: torque = input_torque + vel_gain (clamp(input_vel +
pos_gain (input_pos - pos)) - vel) + integrator, clamped to current_lim; input_vel and
input_torque are each clamped to the same limits first. The firmware runs its loop at 8 kHz;
here it is evaluated once a step.

The current loop's 1 ms is left out, because it changes no joint's motion: a step's torque acts at
once. The estimates are those of `services.simulator.axis_encoders`.

Pure: no clock, no I/O. Arrays are indexed by axis, shape (12,). Units at the motor: turns,
turn/s, N m, A.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.axis_encoders import AxisEncoders
from services.simulator.axis_settings import Settings
from shared.can.cansimple import ControlMode
from shared.robot.joints import N_JOINTS

Vector = NDArray[np.float64]

FIRMWARE_RATE_HZ: Final = 8000.0
INTEGRATOR_DECAY: Final = 0.99
"""Per firmware cycle in which the torque is limited."""


class AxisControl:
    """Inputs and torque of all axes; no state machine, no errors."""

    def __init__(self, settings: Settings, encoders: AxisEncoders) -> None:
        """Take the settings, and the estimates that the law uses."""
        n = N_JOINTS
        self._settings = settings
        self._seen = -1
        self._encoders = encoders
        self._pos, self._vel = encoders.pos_estimate, encoders.vel_estimate
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
        """Fraction of current_lim that heat leaves, where `derated`."""
        self.derated = False
        self.integrator = np.zeros(n)
        self._dt_s = 0.0
        self._decay = 1.0
        self._work, self._high, self._low = np.zeros(n), np.zeros(n), np.zeros(n)
        self._torque_lim, self._torque_min = np.zeros(n), np.zeros(n)
        self._speed = np.zeros(n)

    def regulates(self) -> bool:
        """Return True if any axis in closed loop has a position or velocity loop."""
        if self._seen != self._settings.version:
            self._derive()
        return bool(np.dot(self._regulates, self.armed) > 0.0)

    def too_fast(self) -> bool:
        """Return True if any axis is beyond its OVERSPEED limit; `overspeed` says which."""
        if self._seen != self._settings.version:
            self._derive()
        np.multiply(self.vel_limit, self._tolerance, out=self._high)
        np.abs(self._vel, out=self._speed)
        return bool(np.count_nonzero(self._speed > self._high))

    def overspeed(self) -> list[int]:
        """Return the axes beyond their OVERSPEED limit; in IDLE it is checked all the same."""
        return np.flatnonzero((self._speed > self._high) * self.connected).tolist()

    def stay(self, axis: int) -> None:
        """Make where the motor is its target, in position mode: `control_mode_updated`."""
        if self.control_mode[axis] >= ControlMode.POSITION:
            self.input_pos[axis] = self._pos[axis]

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

    def _derive(self) -> None:
        """Compute what follows from the settings."""
        axis = self._settings.axis
        self._seen = self._settings.version
        self._torque_constant = axis("motor.config.torque_constant").copy()
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

    def _limit_torque_mode(self) -> None:
        """Let no axis in torque mode be driven beyond its velocity limit.

        The firmware clamps to vel_gain (+-vel_limit - vel).
        """
        limited, high, low = self._work, self._high, self._low
        np.subtract(self.vel_limit, self._vel, out=high)
        high *= self.vel_gain
        np.add(self.vel_limit, self._vel, out=low)
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
        np.subtract(self.input_pos, self._pos, out=v_err)
        v_err *= self.pos_gain
        if not self._all_position:
            v_err *= self._positions
        np.negative(self._vel_clamp, out=low)
        np.minimum(self.input_vel, self._vel_clamp, out=high)
        np.maximum(high, low, out=high)
        v_err += high
        np.minimum(v_err, self._vel_clamp, out=v_err)
        np.maximum(v_err, low, out=v_err)
        v_err -= self._vel
        if not self._all_regulate:
            v_err *= self._regulates
        np.multiply(v_err, self.vel_gain, out=low)
        self.torque += low
        if np.count_nonzero(self.vel_integrator_gain) or np.count_nonzero(self.integrator):
            self._integrate(v_err)

    def _integrate(self, v_err: Vector) -> None:
        """Add the integrator to the torque and run it on; it decays where that is limited."""
        if self._dt_s != self._encoders.dt_s:
            self._dt_s = self._encoders.dt_s
            self._decay = INTEGRATOR_DECAY ** (FIRMWARE_RATE_HZ * self._dt_s)
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
