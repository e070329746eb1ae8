"""The differential between two motors and a module's two axes (docs/law.md#the-robot).

q_phi, q_theta = (m1 - m2) / 2N, (m1 + m2) / 2N, with motor positions m1, m2. Power is the same on
both sides, so tau_1 = (tau_theta + tau_phi) / 2N, tau_2 = (tau_theta - tau_phi) / 2N.

The final limiter here bounds the torque and its rate. It applies a one-sided spring at the soft
stop, a check for finite values, the rate limit, and finally the torque diamond |tau_phi| +
|tau_theta| <= tau_module_max. Pure.
"""

from __future__ import annotations

import math

import msgspec

from shared.bus.messages import Pair
from shared.clamp import clamp
from shared.config.robot_config import RobotConfig
from shared.joints import kind_of


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


class TorqueLimits(msgspec.Struct, frozen=True):
    """Limits of one module's torque."""

    phi: Pair
    """Soft stops (low, high) in rad."""
    theta: Pair
    soft_stop_k_p: float
    """N m/rad beyond a stop."""
    tau_module_max: float
    """N m"""
    tau_step_max: float
    """N m from one cycle to the next."""


def limits_of(config: RobotConfig, module: str) -> TorqueLimits:
    """Return a module's limits from the configuration."""
    limit = getattr(config.limits, kind_of(module))
    service = config.joint_service
    return TorqueLimits(
        phi=limit.phi,
        theta=limit.theta,
        soft_stop_k_p=service.soft_stop_k_p,
        tau_module_max=config.joint.tau_module_max,
        tau_step_max=service.torque_rate_max / service.rate_hz,
    )


def limit_torque(tau: Pair, q: Pair, tau_last: Pair, limits: TorqueLimits) -> Pair:
    """Return the torque that may go to the drive, N m.

    Args:
        tau: requested (tau_phi, tau_theta), N m; any value, even NaN.
        q: measured (phi, theta), rad.
        tau_last: torque sent in the last cycle, N m.
        limits: the module's limits.
    """
    phi = tau[0] + _soft_stop(q[0], limits.phi, limits.soft_stop_k_p)
    theta = tau[1] + _soft_stop(q[1], limits.theta, limits.soft_stop_k_p)
    if not (math.isfinite(phi) and math.isfinite(theta)):
        return tau_last
    step, (last_phi, last_theta) = limits.tau_step_max, tau_last
    phi = clamp(phi, last_phi - step, last_phi + step)
    theta = clamp(theta, last_theta - step, last_theta + step)
    return limit_differential((phi, theta), limits.tau_module_max)


def limit_differential(tau: Pair, tau_module_max: float) -> Pair:
    """Clip each motor's torque: |tau_phi + tau_theta| and |tau_theta - tau_phi| <= max.

    Together these bounds are docs/law.md (4).
    """
    total = clamp(tau[1] + tau[0], -tau_module_max, tau_module_max)
    difference = clamp(tau[1] - tau[0], -tau_module_max, tau_module_max)
    return ((total - difference) * 0.5, (total + difference) * 0.5)


def _soft_stop(q: float, stops: Pair, k_p: float) -> float:
    if q < stops[0]:
        return k_p * (stops[0] - q)
    if q > stops[1]:
        return k_p * (stops[1] - q)
    return 0.0
