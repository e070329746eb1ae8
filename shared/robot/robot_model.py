"""Generated model of the robot, as MJCF, for both Pinocchio and MuJoCo.

The torso is the free root; each leg hangs from it: hip, knee, ankle. The paper writes the joints
from the foot up (docs/law.md#the-robot: R_torso = prod Rx(phi) Ry(theta)). Here, from the torso
down, each module turns first by theta about -y, then by phi about -x, so the joint angles have the
paper's meaning and sign.

Masses are the paper's: two hip modules, batteries and payload in the torso; a module at each knee,
half of it on the thigh and half on the shin; a module in each foot, at the ankle.
"""

from __future__ import annotations

import math

from shared.config.robot_config import GRAVITY, RobotConfig
from shared.config.sections import LimitConfig
from shared.joints import KINDS, SIDES

MODULE_RADIUS = 0.08
"""Radius of the ball that models a module and its rotational inertia, m (assumed)."""

HARD_STOP_MARGIN = 0.15
"""Distance of the hard stops beyond the soft limits, rad (assumed)."""

_SIGN = {"right": -1.0, "left": 1.0}


def side_sign(side: str) -> float:
    """Return -1 for right and +1 for left: the sign of y."""
    return _SIGN[side]


def ankle_positions(config: RobotConfig) -> tuple[tuple[float, float, float], ...]:
    """Return both ankles' world positions with the feet side by side, (right, left), m."""
    return tuple((0.0, side_sign(side) * config.geometry.w_base / 2, 0.0) for side in SIDES)


def mjcf(config: RobotConfig) -> str:
    """Return the robot as MJCF text."""
    geometry = config.geometry
    legs = "".join(_leg(config, side) for side in SIDES)
    harness = numbers(*geometry.harness_point)
    torso_inertia = box_inertia(config.torso_mass, geometry.torso_size)
    return f"""<mujoco model="{config.name}">
  <compiler angle="radian" autolimits="true"/>
  <option gravity="0 0 -{GRAVITY}" timestep="{config.simulation.timestep}"
          integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default>
    <joint type="hinge" armature="{config.joint.armature}"/>
    <geom contype="0" conaffinity="0" density="0"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" pos="0 0 -{geometry.foot_height}"
          contype="1" conaffinity="1"/>
    <body name="torso" pos="0 0 {config.simulation.stand_height}">
      <freejoint name="torso"/>
      {_inertial(config.torso_mass, torso_inertia, numbers(*config.torso_com))}
      <geom name="torso" type="box" size="{numbers(*(s / 2 for s in geometry.torso_size))}"/>
      <site name="harness" pos="{harness}"/>{legs}
    </body>
  </worldbody>
</mujoco>
"""


def _leg(config: RobotConfig, side: str) -> str:
    geometry, half = config.geometry, config.mass.module / 2
    hip = f"0 {side_sign(side) * geometry.w_hip / 2} 0"
    module = _inertial(config.mass.module, ball_inertia(config.mass.module))
    half_at_origin = _inertial(half, ball_inertia(half))
    half_at_knee = _inertial(half, ball_inertia(half), f"0 0 -{geometry.l1}")
    sole = numbers(geometry.l_foot / 2, geometry.w_foot / 2, geometry.foot_height / 4)
    sole_z = -0.75 * geometry.foot_height
    return f"""
      <body name="thigh_{side}" pos="{hip}">{_joints(config, "hip", side)}
        {half_at_knee}
        <geom name="thigh_{side}" type="capsule" size="0.03" fromto="0 0 0 0 0 -{geometry.l1}"/>
        <body name="shin_{side}" pos="0 0 -{geometry.l1}">{_joints(config, "knee", side)}
          {half_at_origin}
          <geom name="shin_{side}" type="capsule" size="0.03" fromto="0 0 0 0 0 -{geometry.l2}"/>
          <body name="foot_{side}" pos="0 0 -{geometry.l2}">{_joints(config, "ankle", side)}
            {module}
            <geom name="sole_{side}" type="box" size="{sole}" pos="0 0 {sole_z}"
                  contype="1" conaffinity="1"/>
          </body>
        </body>
      </body>"""


def _joints(config: RobotConfig, kind: str, side: str) -> str:
    limit: LimitConfig = getattr(config.limits, kind)
    text = ""
    for axis, direction, (low, high) in (
        ("theta", "0 -1 0", limit.theta),
        ("phi", "-1 0 0", limit.phi),
    ):
        stop = numbers(low - HARD_STOP_MARGIN, high + HARD_STOP_MARGIN)
        text += f"""
        <joint name="{kind}_{side}_{axis}" axis="{direction}" range="{stop}"/>"""
    return text


def _inertial(mass: float, inertia: tuple[float, float, float], pos: str = "0 0 0") -> str:
    return f'<inertial pos="{pos}" mass="{mass}" diaginertia="{numbers(*inertia)}"/>'


def box_inertia(mass: float, size: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the principal inertia of a box about its centre, kg m^2; size in m."""
    x, y, z = (side * side for side in size)
    return mass * (y + z) / 12, mass * (x + z) / 12, mass * (x + y) / 12


def ball_inertia(mass: float) -> tuple[float, float, float]:
    """Return the principal inertia of a module's ball, kg m^2."""
    inertia = 0.4 * mass * MODULE_RADIUS**2
    return inertia, inertia, inertia


def numbers(*values: float) -> str:
    """Return numbers as an XML attribute that parses back to the same values."""
    return " ".join(repr(float(value)) for value in values)


def stand_pose(config: RobotConfig, height: float) -> tuple[float, ...]:
    """Return q (12, rad) close to a stand with the torso upright and the COM over the ankles.

    `height` is that of the torso above the ankles, m. In the plane of a leg the shin leans by a,
    the thigh by b. Bisection on a solves x_COM = 0, m_torso (l2 sin a + l1 sin b) + 2 m_act l2 sin
    a = 0, and the leg's length, l2 cos a + l1 cos b = hypot(height, span). The small frontal angles
    that lean each leg by its span from ankle to hip are left at zero; inverse kinematics that
    starts here finds them.
    """
    l1, l2 = config.geometry.l1, config.geometry.l2
    share = (config.torso_mass + 2 * config.mass.module) / config.torso_mass
    span = (config.geometry.w_hip - config.geometry.w_base) / 2

    def thigh(a: float) -> float:
        sine = -share * l2 * math.sin(a) / l1
        return -math.asin(min(1.0, -sine))

    def height_error(a: float, folded: bool) -> float:
        b = -math.pi - thigh(a) if folded else thigh(a)
        return l2 * math.cos(a) + l1 * math.cos(b) - math.hypot(height, span)

    a_max = math.asin(l1 / (share * l2))
    folded = height_error(a_max, folded=False) > 0.0
    low, high = (0.0, a_max)
    rising = height_error(low, folded) < height_error(high, folded)
    for _ in range(60):
        middle = (low + high) / 2
        if (height_error(middle, folded) < 0.0) == rising:
            low = middle
        else:
            high = middle
    a = (low + high) / 2
    b = -math.pi - thigh(a) if folded else thigh(a)
    leg = {"ankle": a, "knee": b - a, "hip": -b}
    return tuple(angle for _ in SIDES for kind in KINDS for angle in (0.0, leg[kind]))
