"""Bodies of the robot as URDF in a ROS 2 message, the only form from which Rerun draws bodies.

The links are the frames of `tools.judge.reports.scene`. All joints are floating: the transforms
give the poses of the frames.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Final
from xml.etree import ElementTree as ET

from shared.robot.frames import FramePose
from tools.judge.reports.foxglove import Entity, Solid

SCHEMA_NAME: Final = "std_msgs/msg/String"
SCHEMA: Final = b"string data\n"
SCHEMA_ENCODING: Final = "ros2msg"
ENCODING: Final = "cdr"
"""Encoding of the message."""
_LITTLE_ENDIAN: Final = b"\x00\x01\x00\x00"


def message(text: str) -> bytes:
    """Return a `std_msgs/msg/String` in CDR."""
    data = text.encode() + b"\0"
    return _LITTLE_ENDIAN + struct.pack("<I", len(data)) + data


def urdf(robot: str, frames: Sequence[FramePose], entities: Iterable[Entity]) -> str:
    """Return the model: a link for each frame and its parents, a visual for each solid."""
    root = ET.Element("robot", name=robot)
    names = dict.fromkeys(name for row in frames for name in (row.parent, row.child))
    links = {name: ET.SubElement(root, "link", name=name) for name in names}
    for entity in entities:
        for solid in entity.solids:
            _add_visual(links[entity.frame], entity.name, solid)
    for row in frames:
        joint = ET.SubElement(root, "joint", name=f"to_{row.child}", type="floating")
        ET.SubElement(joint, "parent", link=row.parent)
        ET.SubElement(joint, "child", link=row.child)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode")


def _add_visual(link: ET.Element, name: str, solid: Solid) -> None:
    visual = ET.SubElement(link, "visual", name=name)
    ET.SubElement(visual, "origin", xyz=_listed(solid.position))
    geometry = ET.SubElement(visual, "geometry")
    x, _, z = solid.size
    if solid.shape == "cube":
        ET.SubElement(geometry, "box", size=_listed(solid.size))
    elif solid.shape == "cylinder":
        ET.SubElement(geometry, "cylinder", radius=str(x / 2), length=str(z))
    else:
        ET.SubElement(geometry, "sphere", radius=str(x / 2))
    material = ET.SubElement(visual, "material", name=name)
    ET.SubElement(material, "color", rgba=_listed(solid.colour))


def _listed(values: Iterable[float]) -> str:
    return " ".join(map(str, values))
