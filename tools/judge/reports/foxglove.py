"""Foxglove's well-known 3-D messages, encoded by its own library. Pure.

`foxglove.FrameTransforms` and `foxglove.SceneUpdate` in protobuf: viewers know them by name.
Lengths and positions are in m, rotations are quaternions (x, y, z, w), colours are (r, g, b, a)
from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

from shared.bus.messages import Vector3
from shared.clock import NS_PER_S
from shared.extras import late
from shared.robot.frames import ORIGIN, UPRIGHT, FramePose, Quaternion

if TYPE_CHECKING:
    import foxglove
    from foxglove import messages as well_known
else:
    well_known = late("foxglove.messages")

Colour: TypeAlias = tuple[float, float, float, float]

ENCODING: Final = "protobuf"
"""Encoding of the messages."""


class Solid(NamedTuple):
    """Body with the axes of its frame; a cylinder stands along z."""

    shape: Literal["cube", "cylinder", "sphere"]
    size: Vector3
    """Size along x, y and z; the diameter where the body is round."""
    colour: Colour
    position: Vector3 = ORIGIN
    """Position of its centre."""


class Arrow(NamedTuple):
    """Arrow in its frame."""

    position: Vector3
    """Position of its tail."""
    rotation: Quaternion
    """Rotation from the x axis to the arrow's direction."""
    length: float
    width: float
    """Diameter of the shaft."""
    colour: Colour


class Entity(NamedTuple):
    """Bodies and arrows fixed to a frame; a later entity of the same name replaces it."""

    frame: str
    name: str
    solids: tuple[Solid, ...] = ()
    arrows: tuple[Arrow, ...] = ()


def transforms_schema() -> foxglove.Schema:
    """Return the schema of `foxglove.FrameTransforms`."""
    return well_known.FrameTransforms.get_schema()


def scene_schema() -> foxglove.Schema:
    """Return the schema of `foxglove.SceneUpdate`."""
    return well_known.SceneUpdate.get_schema()


def transforms(ns: int, rows: Iterable[FramePose]) -> bytes:
    """Encode the poses of frames at a time, ns since 1970."""
    timestamp = _time(ns)
    return well_known.FrameTransforms(
        transforms=[
            well_known.FrameTransform(
                timestamp=timestamp,
                parent_frame_id=row.parent,
                child_frame_id=row.child,
                translation=_vector(row.position),
                rotation=_quaternion(row.rotation),
            )
            for row in rows
        ]
    ).encode()


def scene(ns: int, entities: Iterable[Entity]) -> bytes:
    """Encode entities at a time, ns since 1970."""
    timestamp = _time(ns)
    return well_known.SceneUpdate(entities=[_entity(timestamp, row) for row in entities]).encode()


def _entity(timestamp: well_known.Timestamp, row: Entity) -> well_known.SceneEntity:
    def solids(shape: str, kind: Any, **scales: float) -> list[Any]:
        return [
            kind(pose=_pose(one.position), size=_vector(one.size), color=_colour(one.colour),
                 **scales)
            for one in row.solids
            if one.shape == shape
        ]  # fmt: skip

    return well_known.SceneEntity(
        timestamp=timestamp,
        frame_id=row.frame,
        id=row.name,
        lifetime=well_known.Duration(0),  # no end
        frame_locked=True,
        arrows=[_arrow(arrow) for arrow in row.arrows],
        cubes=solids("cube", well_known.CubePrimitive),
        spheres=solids("sphere", well_known.SpherePrimitive),
        cylinders=solids("cylinder", well_known.CylinderPrimitive, bottom_scale=1.0, top_scale=1.0),
    )


def _arrow(arrow: Arrow) -> well_known.ArrowPrimitive:
    head = min(arrow.length, 3.0 * arrow.width)
    return well_known.ArrowPrimitive(
        pose=_pose(arrow.position, arrow.rotation),
        shaft_length=arrow.length - head,
        shaft_diameter=arrow.width,
        head_length=head,
        head_diameter=2.0 * arrow.width,
        color=_colour(arrow.colour),
    )


_TIME_LAST_NS: Final = (2**32 - 1) * NS_PER_S
"""Stamps of Foxglove are unsigned 32-bit seconds since 1970: they end in 2106."""


def _time(ns: int) -> well_known.Timestamp:
    seconds, rest = divmod(min(max(ns, 0), _TIME_LAST_NS), NS_PER_S)
    return well_known.Timestamp(seconds, rest)


def _pose(position: Vector3, rotation: Quaternion = UPRIGHT) -> well_known.Pose:
    return well_known.Pose(position=_vector(position), orientation=_quaternion(rotation))


def _vector(values: Vector3) -> well_known.Vector3:
    x, y, z = values
    return well_known.Vector3(x=x, y=y, z=z)


def _quaternion(values: Quaternion) -> well_known.Quaternion:
    x, y, z, w = values
    return well_known.Quaternion(x=x, y=y, z=z, w=w)


def _colour(values: Colour) -> well_known.Color:
    r, g, b, a = values
    return well_known.Color(r=r, g=g, b=b, a=a)
