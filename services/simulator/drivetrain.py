"""Motors, gears and chains between the drives' torque and the joints. Pure.

Each of the 12 joint axes has a rotor of its own behind a spring with damping and play:

    I w' = tau_motor - tau_spring - d_m w - cogging - dry friction
    tau_spring = k dead(theta - q) + b (w - q')        where the play is taken up
    dead(x) = x - clip(x, -play/2, play/2)

theta, w: the rotor's angle and rate at the joint; both motors of a module are alike, so rotor
inertia is diagonal in the joints' (phi, theta) as well. The joint's share of the damping, b q',
is left to the body's own integrator, which is implicit in it. The encoders see theta.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from services.simulator.plant import Drivetrain
from shared.joints import N_JOINTS

Array = NDArray[np.float64]


class FlexibleDrivetrain:
    """The 12 rotors.

    Attributes:
        theta: rotor angles at the joint (12,), rad.
        rate: rad/s.
        damping: of the spring on the joint in this step (12,), N m s/rad: 0 within the play.
    """

    def __init__(self, config: Drivetrain, motor_from_joint: Array, dt: float) -> None:
        """Take the drivetrain.

        Args:
            config: stiffness must be finite.
            motor_from_joint: motor turns per joint angle (12, 12), turns/rad.
            dt: step, s.
        """
        n = N_JOINTS
        self._k, self._b = config.stiffness, config.damping_s * config.stiffness
        self._half_play = 0.5 * config.play
        self._dt = dt
        self._per_inertia = dt / config.rotor_inertia
        self._friction_step = config.motor_friction * self._per_inertia
        self._own_damping = config.motor_damping * self._per_inertia
        self._spring_damping = self._b * self._per_inertia
        self._cogging_angle = 2.0 * math.pi * config.cogging_periods * motor_from_joint
        self._cogging: Array = config.cogging * np.sign(motor_from_joint.T)
        self._has_cogging = config.cogging > 0.0
        self.theta: Array = np.zeros(n)
        self.rate: Array = np.zeros(n)
        self.damping: Array = np.zeros(n)
        self._stretch, self._inside = np.zeros(n), np.zeros(n)
        self._tau, self._work = np.zeros(n), np.zeros(n)

    def settle(self, q: Array) -> None:
        """Put the rotors where the joints (12,), rad, are, at rest."""
        self.theta[:] = q
        self.rate[:] = 0.0

    def step(self, tau_motor: Array, q: Array, v: Array) -> Array:
        """Move the rotors on by one step; return what the springs give the joints (12,), N m.

        Without `damping` times v, which is for the body's integrator.

        Args:
            tau_motor: motor torques at the joints (12,), N m.
            q: joint angles (12,), rad.
            v: joint rates (12,), rad/s.
        """
        stretch, inside, tau, work, rate = (
            self._stretch, self._inside, self._tau, self._work, self.rate,
        )  # fmt: skip
        np.subtract(self.theta, q, out=stretch)
        if self._half_play > 0.0:
            np.minimum(stretch, self._half_play, out=inside)
            np.maximum(inside, -self._half_play, out=inside)
            stretch -= inside
            np.not_equal(stretch, 0.0, out=work)
            np.multiply(work, self._b, out=self.damping)
            np.multiply(work, self._spring_damping, out=work)
        else:
            self.damping.fill(self._b)
            work.fill(self._spring_damping)
        np.multiply(stretch, self._k, out=tau)
        # backward Euler in the dampers: (1 + dt b / I + dt d / I) w_new = w + dt / I (...)
        np.subtract(tau_motor, tau, out=inside)
        if self._has_cogging:
            inside -= self._cogging @ np.sin(self._cogging_angle @ self.theta)
        inside *= self._per_inertia
        rate += inside
        np.multiply(work, v, out=inside)
        rate += inside
        work += 1.0 + self._own_damping
        rate /= work
        # dry friction takes off what it can and stops there
        np.minimum(rate, self._friction_step, out=inside)
        np.maximum(inside, -self._friction_step, out=inside)
        rate -= inside
        np.multiply(rate, self._dt, out=inside)
        self.theta += inside
        np.multiply(self.damping, rate, out=inside)
        tau += inside
        return tau
