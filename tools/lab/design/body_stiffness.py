"""Computes the body stiffness needed to balance, from the paper's section IV. Pure.

The robot leans as an inverted pendulum of mass m and height z over two ankles. The ankles are not
part of m, because they do not move:

    theta_max  = arcsin(2 tau_max / (m g z))     lean that uses up the ankles' torque
    theta_edge = arctan(half sole / z)           lean that puts the COM over the sole's edge
    tau_edge   = m g z / 2 sin(theta_edge)       each ankle's torque there
    K_ank_min  = tau_edge / theta_edge           N m/rad, each ankle
    K_x_min    = 2 K_ank_min / z^2               N/m, in the body's coordinates
    K_x(tau)   = 2 tau_max / (theta_edge z^2)    uses up tau_max at the edge

The paper's formula for theta_edge prints l_foot, but its text and its number (2.81 deg) use
w_foot / 2. Here x uses l_foot and y uses w_foot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from shared.config.robot_config import GRAVITY, RobotConfig


class BodyStiffness(NamedTuple):
    """Stiffness design for one direction."""

    theta_max: float
    """rad; NaN if the ankles can hold any lean."""
    theta_edge: float
    """rad"""
    tau_edge: float
    """N m, each ankle."""
    K_ank_min: float
    """N m/rad, each ankle."""
    K_min: float
    """N/m"""
    K_tau_max: float
    """N/m; with it the ankles produce tau_max at the sole's edge."""


def for_robot(config: RobotConfig) -> dict[str, BodyStiffness]:
    """Return the stiffness design along x and y, upright with straight legs.

    The soles are side by side: x uses half their length, y half their width. As in the paper, the
    distance between the legs, which helps in y, is left out.
    """
    geometry, tau_max = config.geometry, config.joint.tau_module_max
    height = geometry.l1 + geometry.l2
    weight_moment = (config.torso_mass + 2 * config.mass.module) * GRAVITY * height
    sine = 2.0 * tau_max / weight_moment
    found = {}
    for direction, half_sole in (("x", geometry.l_foot / 2), ("y", geometry.w_foot / 2)):
        theta_edge = math.atan(half_sole / height)
        tau_edge = 0.5 * weight_moment * math.sin(theta_edge)
        K_ank_min = tau_edge / theta_edge
        found[direction] = BodyStiffness(
            theta_max=math.asin(sine) if sine <= 1.0 else math.nan,
            theta_edge=theta_edge,
            tau_edge=tau_edge,
            K_ank_min=K_ank_min,
            K_min=2.0 * K_ank_min / height**2,
            K_tau_max=2.0 * tau_max / (theta_edge * height**2),
        )
    return found
