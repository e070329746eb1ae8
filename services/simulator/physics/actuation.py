"""From the drives' torques to the joints, and from the joints to the encoders. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from services.simulator.physics.body import Body
from services.simulator.physics.drivetrain import FlexibleDrivetrain
from services.simulator.physics.plant import RIGID
from shared.joints import N_JOINTS

Array = NDArray[np.float64]

NOISE_ROWS: Final = 4093
"""Samples of noise drawn at the start and then repeated: 4 s at 1 kHz, and a prime."""


class Actuation:
    """Torque lag and delay, drivetrain and encoders of the 12 axes."""

    def __init__(self, body: Body, dt: float) -> None:
        """Take the true robot and the step, s."""
        n, drive = N_JOINTS, body.drive
        turns = body.motor_from_joint
        self._turns = turns
        # power is the same on both sides: tau = (d motor angle / d joint angle)^T torque
        self._tau_from_motor: Array = 2.0 * math.pi * drive.torque_scale * turns.T.copy()
        self._lags = drive.lag_s > 0.0
        self._follow = 1.0 - math.exp(-dt / drive.lag_s) if self._lags else 1.0
        self._waiting: Array = np.zeros((round(drive.delay_s / dt), n))
        self._oldest = 0
        self._tau: Array = np.zeros(n)
        self._wanted: Array = np.zeros(n)
        self._acting: Array = np.zeros(n)
        flexible = body.drivetrain.stiffness != RIGID
        self.flexible = FlexibleDrivetrain(body.drivetrain, turns, dt) if flexible else None
        """None: the joints are the motors."""
        self._offset: Array = turns @ np.array(body.encoder.zero_errors)
        noise = body.encoder.noise_counts / body.counts_per_turn
        rng = np.random.default_rng(body.seed)
        self._noise: Array = noise * rng.standard_normal((NOISE_ROWS if noise else 1, n))
        self._reads = 0

    def settle(self, q: Array) -> None:
        """Be at rest at joint angles q (12,), rad."""
        if self.flexible is not None:
            self.flexible.settle(q)

    def torque(self, motor_torque: Array, q: Array, v: Array) -> Array:
        """Move on by one step; return what acts on the joints (12,), N m.

        Of a flexible drivetrain without `flexible.damping` times v.

        Args:
            motor_torque: that the drives want (12,), N m.
            q: joint angles (12,), rad.
            v: joint rates (12,), rad/s.
        """
        wanted = np.matmul(self._tau_from_motor, motor_torque, out=self._wanted)
        if len(self._waiting):
            row = self._waiting[self._oldest]
            late = row.copy()
            row[:] = wanted
            self._oldest = (self._oldest + 1) % len(self._waiting)
            wanted[:] = late
        acting = self._acting
        if self._lags:  # at the step's begin: positions are then right to second order in dt
            acting[:] = self._tau
            wanted -= self._tau
            wanted *= self._follow
            self._tau += wanted
        else:
            acting[:] = wanted
        return acting if self.flexible is None else self.flexible.step(acting, q, v)

    def encoders(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the encoders' motor angles (12,), turns, and the true rates, turn/s.

        Args:
            q: angles of the rotors (12,), rad at the joints.
            v: their rates (12,), rad/s.
        """
        turns = self._turns @ q
        turns += self._offset
        turns += self._noise[self._reads % len(self._noise)]
        self._reads += 1
        return turns, self._turns @ v

    def state(self) -> list[float]:
        """Return everything that `restore` goes on from."""
        rotors = [] if self.flexible is None else [*self.flexible.theta, *self.flexible.rate]
        waiting = np.roll(self._waiting, -self._oldest, axis=0).ravel()
        return [float(x) for x in (self._reads, *self._tau, *waiting, *rotors)]

    def restore(self, state: Sequence[float]) -> None:
        """Go on from a state of the same plant."""
        values, n = np.array(state), N_JOINTS
        self._reads, self._oldest = int(values[0]), 0
        end = 1 + n + self._waiting.size
        self._tau[:], self._waiting[:] = values[1 : 1 + n], values[1 + n : end].reshape(-1, n)
        if self.flexible is not None:
            self.flexible.theta[:], self.flexible.rate[:] = values[end : end + n], values[end + n :]
