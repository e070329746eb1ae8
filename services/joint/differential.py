"""The differential between two motors and a module's two axes (docs/law.md#the-robot).

q_phi, q_theta = (m1 - m2) / 2N, (m1 + m2) / 2N, in turns at the motors. Power is the
same on both sides, so tau_1 = (tau_theta + tau_phi) / 2N, tau_2 = (tau_theta - tau_phi) / 2N.
"""

from __future__ import annotations

import math

from shared.bus.messages import Pair


def joint_from_motor(motor_turns: Pair, gear_ratio: float) -> Pair:
    """Return (phi, theta) in rad (or rad/s) from motor turns (or turn/s): docs/law.md (3)."""
    half = math.pi / gear_ratio  # 2 pi / 2 N
    m1, m2 = motor_turns
    return ((m1 - m2) * half, (m1 + m2) * half)


def motor_from_joint(joint: Pair, gear_ratio: float) -> Pair:
    """Return motor turns (or turn/s) from (phi, theta) in rad (or rad/s)."""
    scale = gear_ratio / (2.0 * math.pi)
    phi, theta = joint
    return ((theta + phi) * scale, (theta - phi) * scale)


def motor_torque(tau: Pair, gear_ratio: float) -> Pair:
    """Return motor torques in N m from joint torques (tau_phi, tau_theta) in N m."""
    scale = 0.5 / gear_ratio
    return ((tau[1] + tau[0]) * scale, (tau[1] - tau[0]) * scale)


def joint_torque(motor: Pair, gear_ratio: float) -> Pair:
    """Return (tau_phi, tau_theta) in N m from motor torques in N m."""
    return ((motor[0] - motor[1]) * gear_ratio, (motor[0] + motor[1]) * gear_ratio)
