"""Motors, gears and chains between the drives' torque and the joints. Pure.

Each of the 12 joint axes has a rotor of its own behind a spring with damping and play:

    I w' = tau_motor - tau_spring - d_m w - cogging - dry friction
    tau_spring = k dead(theta - q) + b (w - q')        where the play is taken up
    dead(x) = x - clip(x, -play/2, play/2)

theta, w: the rotor's angle and rate at the joint; both motors of a module are equal, so rotor
inertia is diagonal in the joints' (phi, theta) too. The joint's share of the damping, b q', is left
to the body's own integrator, which is implicit in it. The encoders see theta.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from services.simulator.physics.plant import Drivetrain
from shared.joints import N_JOINTS
from shared.robot.compiled_graph import CompiledGraph

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
        self._graph = CompiledGraph(step_graph(config, motor_from_joint, dt))
        self.theta, self.rate, *self._arguments = self._graph.arguments
        self._theta_next, self._rate_next, self._tau, self.damping = self._graph.results

    def settle(self, q: Array) -> None:
        """Put the rotors where the joints (12,), rad, are, at rest."""
        self.theta[:] = q
        self.rate[:] = 0.0

    def step(self, tau_motor: Array, q: Array, v: Array) -> Array:
        """Advance the rotors by one step; return the springs' torques on the joints (12,), N m.

        `damping` times v is left to the body's integrator. The next call overwrites the result.

        Args:
            tau_motor: motor torques at the joints (12,), N m.
            q: joint angles (12,), rad.
            v: joint rates (12,), rad/s.
        """
        tau_now, q_now, v_now = self._arguments
        tau_now[:], q_now[:], v_now[:] = tau_motor, q, v
        self._graph()
        self.theta[:], self.rate[:] = self._theta_next, self._rate_next
        return self._tau


def step_graph(config: Drivetrain, motor_from_joint: Array, dt: float) -> ca.Function:
    """Return (theta, w, tau_motor, q, q') -> (theta, w, tau_spring + b w, b): one step."""
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
