"""A robot standing still at a pose: the law's ingredients, and what it feels by the oracle."""

from __future__ import annotations

import numpy as np

from services.planner.law.certificate import Certificate
from services.planner.law.gains import GainLaw, JointGains
from services.planner.law.kinematics import Kinematics
from services.planner.law.split import GainSplit, LocalGains
from shared.arrays import Array
from shared.config.robot_config import RobotConfig
from tests.planner import oracle

STEP = 1e-4


class Stand:
    """A pose, and a certificate that was moved there; `assist` in N."""

    def __init__(self, robot: RobotConfig, q: Array, assist: float) -> None:
        self.robot, self.q, self.p = robot, q, oracle.pose(robot, q)
        self.T = oracle.feasible(robot, q)
        self.kinematics = Kinematics(robot)
        self.kinematics.update(q)
        F_O = np.array([0.0, 0.0, oracle.masses(robot)[1] * oracle.GRAVITY, 0.0, 0.0, 0.0])
        self.F_assist = np.array([0.0, 0.0, assist])
        self.tau_ff = F_O @ self.kinematics.J + self.F_assist @ self.kinematics.J_harness
        self.hessian_O = self.kinematics.hessian_times(F_O, self.F_assist).copy()
        self.certificate = Certificate(robot)
        self.certificate.at(self.T, self.hessian_O)

    def stiffness_felt(self, D: Array) -> Array:
        """Return the curvature (6, 6) of the energy by p, by the oracle; asserts balance.

        The weight, the operator's load pressing down at the harness with what the assist
        lifts, springs D wound about the pose, and torques held as they are there.
        """
        q_of = oracle.closed_chain(self.robot, self.q)

        def energy(p: Array) -> Array:
            q = q_of(p)
            gravity = oracle.potential_energy(self.robot, q)
            load = self.F_assist @ oracle.harness(self.robot, q)
            away = q - self.q
            return np.array(gravity + load + 0.5 * away @ (D * away) - self.tau_ff @ q)

        slope = oracle.precise_derivative(energy, self.p, STEP)
        np.testing.assert_allclose(slope, 0.0, atol=2e-5)
        return oracle.second_derivative(energy, self.p, STEP)

    def gains(self) -> JointGains:
        """Return K_q and B_q here."""
        return GainLaw(self.robot).gains(self.kinematics, self.hessian_O)

    def split(self, split: GainSplit) -> LocalGains:
        """Return the local gains that a split chooses here."""
        z, pitch = float(self.p[2]), float(self.p[4])
        return split.split(self.gains, z, pitch, self.T, self.hessian_O)
