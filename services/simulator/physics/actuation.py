"""Torques from the drives to the joints, and angles from the joints to the encoders. Pure.

Each of the 12 joint axes has its own rotor behind a spring with damping and play:

    I w' = tau_motor - tau_spring - d_m w - cogging - dry friction
    tau_spring = k dead(theta - q) + b (w - q')        b = 0 inside the play
    dead(x) = x - clip(x, -play/2, play/2)

theta and w are the rotor's angle and rate at the joint. Both motors of a module are equal, so the
rotor inertia is diagonal in the joints' (phi, theta) too. The body's own integrator, which is
implicit, applies the joint's share of the damping, b q'. The encoders measure theta.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import casadi as ca
import numpy as np

from services.simulator.physics.body import Body
from services.simulator.physics.plant import RIGID, Drivetrain
from shared.arrays import Array
from shared.joints import N_JOINTS
from shared.robot.compiled_graph import CompiledGraph

NOISE_ROWS: Final = 4093
"""Number of noise samples, a prime: drawn at the start, then repeated every 4 s at 1 kHz."""


class Actuation:
    """Torque lag and delay, drivetrain and encoders of the 12 axes.

    Attributes:
        flexible: the rotors; None if the drivetrain is rigid.
        tau_from_motor: joint torques per motor torque (12, 12).
    """

    def __init__(self, body: Body, dt: float) -> None:
        """Set the true robot and the time step `dt`, s."""
        n, plant, turns = N_JOINTS, body.plant, body.motor_from_joint
        drive = plant.drive
        self._turns = turns
        # power is the same on both sides: tau = (d motor angle / d joint angle)^T torque
        self.tau_from_motor: Array = 2.0 * math.pi * drive.torque_scale * turns.T.copy()
        self._lags = drive.lag_s > 0.0
        self._follow = 1.0 - math.exp(-dt / drive.lag_s) if self._lags else 1.0
        self._waiting: Array = np.zeros((round(drive.delay_s / dt), n))
        """Delayed torques, the oldest first."""
        self._tau: Array = np.zeros(n)
        """Torques after the lag of the current loops."""
        self._wanted: Array = np.zeros(n)
        self._acting: Array = np.zeros(n)
        flexible = plant.drivetrain.stiffness != RIGID
        self.flexible = FlexibleDrivetrain(plant.drivetrain, turns, dt) if flexible else None
        self._offset: Array = turns @ np.array(plant.encoder.zero_errors)
        noise = plant.encoder.noise_counts / body.counts_per_turn
        rng = np.random.default_rng(plant.seed)
        self._noise: Array = noise * rng.standard_normal((NOISE_ROWS if noise else 1, n))
        self._reads = 0

    def settle(self, q: Array) -> None:
        """Set the rotors to joint angles q (12,), rad, at rest."""
        if self.flexible is not None:
            self.flexible.settle(q)

    def torque(self, motor_torque: Array, q: Array, v: Array) -> Array:
        """Advance by one step; return the torques on the joints (12,), N m.

        With a flexible drivetrain, the body's integrator then subtracts `flexible.damping` times v.
        `motor_torque` (12,), N m, is the drives' command.
        """
        wanted = np.matmul(self.tau_from_motor, motor_torque, out=self._wanted)
        if len(self._waiting):
            late = self._waiting[0].copy()
            self._waiting[:-1] = self._waiting[1:]
            self._waiting[-1] = wanted
            wanted[:] = late
        acting = self._acting
        if self._lags:  # torque at the step's start: positions are correct to second order in dt
            acting[:] = self._tau
            wanted -= self._tau
            wanted *= self._follow
            self._tau += wanted
        else:
            acting[:] = wanted
        return acting if self.flexible is None else self.flexible.step(acting, q, v)

    def encoders(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the encoders' motor angles (12,), turns, and the true rates, turn/s.

        q and v are angles and rates of the rotors (12,), rad and rad/s at the joints.
        """
        turns = self._turns @ q
        turns += self._offset
        turns += self._noise[self._reads % len(self._noise)]
        self._reads += 1
        return turns, self._turns @ v

    def numbers(self) -> list[float]:
        """Return the state that changes between steps as one list."""
        columns = (column.ravel() for column in self._columns())
        return [float(self._reads), *np.concatenate([*columns]).tolist()]

    def set_numbers(self, numbers: Sequence[float]) -> None:
        """Restore the state that `numbers` returned for the same plant."""
        self._reads, rest = int(numbers[0]), np.array(numbers[1:])
        for column in self._columns():
            column[:] = rest[: column.size].reshape(column.shape)
            rest = rest[column.size :]

    def _columns(self) -> tuple[Array, ...]:
        rotors = () if self.flexible is None else (self.flexible.theta, self.flexible.rate)
        return (self._tau, self._waiting, *rotors)


class FlexibleDrivetrain:
    """The 12 rotors.

    Attributes:
        theta: rotor angles at the joint (12,), rad.
        rate: rotor rates at the joint (12,), rad/s.
        damping: the spring's damping on the joint in this step (12,), N m s/rad: 0 in the play.
    """

    def __init__(self, config: Drivetrain, motor_from_joint: Array, dt: float) -> None:
        """Build the step for a finite stiffness; `motor_from_joint` (12, 12) is in turns/rad."""
        self._graph = CompiledGraph(step_graph(config, motor_from_joint, dt))
        self.theta, self.rate, *self._arguments = self._graph.arguments
        self._theta_next, self._rate_next, self._tau, self.damping = self._graph.results

    def settle(self, q: Array) -> None:
        """Set the rotors to joint angles (12,), rad, at rest."""
        self.theta[:] = q
        self.rate[:] = 0.0

    def step(self, tau_motor: Array, q: Array, v: Array) -> Array:
        """Advance the rotors by one step; return the springs' torques on the joints (12,), N m.

        The body's integrator subtracts `damping` times v. The next call overwrites the result.
        `tau_motor` (12,), N m, are the motors' torques at the joints.
        """
        tau_now, q_now, v_now = self._arguments
        tau_now[:], q_now[:], v_now[:] = tau_motor, q, v
        self._graph()
        self.theta[:], self.rate[:] = self._theta_next, self._rate_next
        return self._tau


def step_graph(config: Drivetrain, motor_from_joint: Array, dt: float) -> ca.Function:
    """Return one step: (theta, w, tau_motor, q, q') -> (theta, w, tau_spring + b q', b)."""
    theta, rate, tau_motor, q, v = (ca.SX.sym(name, N_JOINTS) for name in "trmqv")
    k, b = config.stiffness, config.damping_s * config.stiffness
    half = 0.5 * config.play
    inside = ca.fmin(ca.fmax(theta - q, -half), half)
    stretch = theta - q - inside
    damping = b * (ca.fabs(theta - q) > half) if config.play > 0.0 else b * ca.SX.ones(N_JOINTS)
    angle = 2.0 * math.pi * config.cogging_periods * (ca.DM(motor_from_joint) @ theta)
    cogging = config.cogging * (ca.DM(np.sign(motor_from_joint.T)) @ ca.sin(angle))
    per_inertia = dt / config.rotor_inertia
    # backward Euler in the dampers: (1 + dt b / I + dt d / I) w_new = w + dt / I (...)
    driven = rate + per_inertia * (tau_motor - k * stretch - cogging + damping * v)
    free = driven / (1.0 + per_inertia * (damping + config.motor_damping))
    # dry friction can stop a rotor but not reverse it
    most = config.motor_friction * per_inertia
    rate_next = free - ca.fmin(ca.fmax(free, -most), most)
    tau = k * stretch + damping * rate_next
    return ca.Function(
        "drivetrain",
        [theta, rate, tau_motor, q, v],
        [ca.densify(x) for x in (theta + dt * rate_next, rate_next, tau, damping)],
        {"cse": True},
    )
