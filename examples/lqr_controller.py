"""A controller of your own: linear quadratic regulation (LQR) of the body.

The model is the inertia of the standing robot along its pose p. For the directions that the person
does not lead (x, y, roll, yaw), a Riccati equation gives the wrench for an error of pose and rate.
The controller subtracts the wrench of the joints' local gains, and low-passes the rest because the
joints flex. References, feedforward and certified gains are those of the shipped law.

    xrl sim --controller examples/lqr_controller.py
    xrl demo --controller examples/lqr_controller.py     # live: the planner is killed at 10 s
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import solve_continuous_are

from services.planner.controller import Action, Observation
from services.planner.law.kinematics import Kinematics
from services.planner.law.model import BodyInertia
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from shared.robot.robot_model import stand_pose

CLOSED = (0, 1, 3, 5)  # x, y, roll, yaw of p
# Bryson's rule: each cost is one over the square of the accepted value.
ERROR = (0.01, 0.01, 0.02, 0.05)  # m, m, rad, rad
RATE = (0.2, 0.2, 0.4, 1.0)  # m/s, m/s, rad/s, rad/s
WRENCH = (28.0, 28.0, 16.0, 20.0)  # N, N, N m, N m
LOW_PASS_HZ = 4.0
DAMPED = 0.15  # fraction of the rate gains: with 1, the joints oscillate and the modules hold


class Controller:
    """LQR with the references of the shipped law."""

    def __init__(self, robot: RobotConfig) -> None:
        """Solve the Riccati equation for the standing robot."""
        q = np.array(stand_pose(robot, robot.simulation.stand_height))
        body = Kinematics(robot)
        body.update(q)
        T = np.linalg.solve(np.vstack([body.J, body.C]), np.eye(12, 6))  # legs stay closed
        M = BodyInertia(robot).at(q, T)[np.ix_(CLOSED, CLOSED)]
        n = len(CLOSED)
        A = np.block([[np.zeros((n, n)), np.eye(n)], [np.zeros((n, 2 * n))]])
        B = np.vstack([np.zeros((n, n)), np.linalg.inv(M)])
        Q, R = (np.diag(1.0 / np.square(values)) for values in ((*ERROR, *RATE), WRENCH))
        P = solve_continuous_are(A, B, Q, R)
        self.K: Array = np.linalg.solve(R, B.T @ P)  # (4, 8): wrench per error of pose and rate
        self.K[:, n:] *= DAMPED
        self._coupled: Array = np.zeros(12)

    def reset(self, seen: Observation) -> None:  # noqa: ARG002 - the start is always the same
        """Start without coupled torque."""
        self._coupled[:] = 0.0

    def step(self, seen: Observation) -> Action:
        """Return the shipped law's action with the LQR's coupled torque."""
        law = seen.law
        error = np.concatenate([(law.p_ref - seen.p)[list(CLOSED)], -seen.pdot[list(CLOSED)]])
        wrench = np.zeros(6)
        wrench[list(CLOSED)] = self.K @ error
        local = law.local.D * (law.q_ref - seen.q) + law.local.D_B * (law.v_ref - seen.v)
        wrench[list(CLOSED)] -= (seen.T.T @ local)[list(CLOSED)]
        fraction = 1.0 - math.exp(-2.0 * math.pi * LOW_PASS_HZ * seen.dt)
        self._coupled += fraction * (seen.J.T @ wrench - self._coupled)
        return Action.from_law(law)._replace(tau_coupled=self._coupled.copy())
