"""The robot as URDF, for ROS 2: the links, joints, masses and shapes of `shared.robot.robot_model`.

`torso` is the root. A module has two joints, theta about -y and phi about -x. A link without mass
(`cross_of`) connects the part above the module and the part below, which has the module's name. The
joints have the names and signs of q (`shared.joints`).
"""

from __future__ import annotations

from typing import Final
from xml.etree import ElementTree as ET

from shared.bus.messages import Vector3
from shared.config.robot_config import RobotConfig
from shared.config.sections import LimitConfig
from shared.joints import SIDES, kind_of
from shared.robot.frames import ORIGIN, leg_modules
from shared.robot.robot_model import MODULE_RADIUS, ball_inertia, box_inertia, numbers

THETA_AXIS: Final[Vector3] = (0.0, -1.0, 0.0)
PHI_AXIS: Final[Vector3] = (-1.0, 0.0, 0.0)
LINK_RADIUS: Final = 0.03
"""m"""
_GREY: Final = "0.62 0.66 0.70 1"


def cross_of(module: str) -> str:
    """Return the name of the link between a module's two joints."""
    return f"{module}_cross"


def urdf(config: RobotConfig) -> str:
    """Return the robot as URDF text; lengths in m, masses in kg, angles in rad."""
    root = ET.Element("robot", name=config.name)
    geometry = config.geometry
    torso = ET.SubElement(root, "link", name="torso")
    size = geometry.torso_size
    inertia = box_inertia(config.torso_mass, size)
    _add_inertial(torso, config.torso_mass, inertia, config.torso_com)
    _add_visual(torso, "box", size=numbers(*size))
    _add_fixed(root, "torso", "harness", geometry.harness_point)
    for side in SIDES:
        for parent, module, offset in leg_modules(geometry, side):
            ET.SubElement(root, "link", name=cross_of(module))
            link = ET.SubElement(root, "link", name=module)
            _add_body(link, config, kind_of(module))
            _add_joint(root, config, f"{module}_theta", (parent, cross_of(module)), offset)
            _add_joint(root, config, f"{module}_phi", (cross_of(module), module), ORIGIN)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode")


def _add_body(link: ET.Element, config: RobotConfig, kind: str) -> None:
    """Add mass and shapes of the part below a module: thigh, shin or foot."""
    geometry, module = config.geometry, config.mass.module
    _add_visual(link, "sphere", radius=repr(MODULE_RADIUS))
    if kind == "ankle":
        _add_inertial(link, module, ball_inertia(module))
        size = (geometry.l_foot, geometry.w_foot, geometry.foot_height / 2)
        centre = (0.0, 0.0, -0.75 * geometry.foot_height)
        _add_visual(link, "box", centre, size=numbers(*size))
        return
    length = geometry.l1 if kind == "hip" else geometry.l2
    at = (0.0, 0.0, -length) if kind == "hip" else ORIGIN  # half of the knee's module on each side
    _add_inertial(link, module / 2, ball_inertia(module / 2), at)
    middle = (0.0, 0.0, -length / 2)
    _add_visual(link, "cylinder", middle, radius=repr(LINK_RADIUS), length=repr(length))


def _add_joint(
    root: ET.Element, config: RobotConfig, name: str, links: tuple[str, str], at: Vector3
) -> None:
    module, _, axis = name.rpartition("_")
    limit: LimitConfig = getattr(config.limits, kind_of(module))
    low, high = limit.theta if axis == "theta" else limit.phi
    joint = ET.SubElement(root, "joint", name=name, type="revolute")
    ET.SubElement(joint, "parent", link=links[0])
    ET.SubElement(joint, "child", link=links[1])
    ET.SubElement(joint, "origin", xyz=numbers(*at))
    ET.SubElement(joint, "axis", xyz=numbers(*(THETA_AXIS if axis == "theta" else PHI_AXIS)))
    effort, velocity = config.joint.tau_module_max, config.joint_service.v_max
    ET.SubElement(
        joint, "limit", lower=repr(low), upper=repr(high), effort=repr(effort),
        velocity=repr(velocity),
    )  # fmt: skip


def _add_fixed(root: ET.Element, parent: str, child: str, at: Vector3) -> None:
    ET.SubElement(root, "link", name=child)
    joint = ET.SubElement(root, "joint", name=f"to_{child}", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=numbers(*at))


def _add_inertial(link: ET.Element, mass: float, inertia: Vector3, at: Vector3 = ORIGIN) -> None:
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=numbers(*at))
    ET.SubElement(inertial, "mass", value=repr(mass))
    (ixx, iyy, izz), off = map(repr, inertia), "0"
    ET.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy=off, ixz=off, iyz=off)


def _add_visual(link: ET.Element, shape: str, at: Vector3 = ORIGIN, **size: str) -> None:
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=numbers(*at))
    ET.SubElement(ET.SubElement(visual, "geometry"), shape, size)
    material = ET.SubElement(visual, "material", name="grey")
    ET.SubElement(material, "color", rgba=_GREY)
