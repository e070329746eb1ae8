"""A controller of your own: linear quadratic regulation of the body, in the planner's place.

The body is taken as six masses on its pose p, with the inertia at the stand. Along the directions
that the person does not lead (x, y, roll, yaw) a Riccati equation gives the wrench for an error of
pose and rate. What the local gains of the joints give already is taken off; the rest goes through a
low-pass, since the joints flex. References, weight and certified gains are the shipped law's.

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
# Bryson's rule: each cost is one over the square of what is accepted.
ERROR = (0.01, 0.01, 0.02, 0.05)  # m, m, rad, rad
RATE = (0.2, 0.2, 0.4, 1.0)  # m/s, m/s, rad/s, rad/s
WRENCH = (28.0, 28.0, 16.0, 20.0)  # N, N, N m, N m
LOW_PASS_HZ = 4.0
DAMPED = 0.15  # of the rate gains: with 1 the flexible joints oscillate, and the modules let go


class Controller:
    """LQR with the shipped law's references."""

    def __init__(self, robot: RobotConfig) -> None:
        """Solve the Riccati equation for the robot's stand."""
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
        self.K: Array = np.linalg.solve(R, B.T @ P)  # (4, 8): wrench for error of pose and rate
        self.K[:, n:] *= DAMPED
        self._coupled: Array = np.zeros(12)

    def reset(self, seen: Observation) -> None:  # noqa: ARG002 - it begins alike everywhere
        """Begin without torque over the body."""
        self._coupled[:] = 0.0

    def step(self, seen: Observation) -> Action:
        """Return the shipped action with LQR's torque in the place of the coupled one."""
        law = seen.law
        error = np.concatenate([(law.p_ref - seen.p)[list(CLOSED)], -seen.pdot[list(CLOSED)]])
        wrench = np.zeros(6)
        wrench[list(CLOSED)] = self.K @ error
        local = law.local.D * (law.q_ref - seen.q) + law.local.D_B * (law.v_ref - seen.v)
        wrench[list(CLOSED)] -= (seen.T.T @ local)[list(CLOSED)]
        fraction = 1.0 - math.exp(-2.0 * math.pi * LOW_PASS_HZ * seen.dt)
        self._coupled += fraction * (seen.J.T @ wrench - self._coupled)
        return Action.from_law(law)._replace(tau_coupled=self._coupled.copy())
