"""Foxglove's well-known messages for 3-D, encoded and described by its own library. Pure.

`foxglove.FrameTransforms` and `foxglove.SceneUpdate`, in protobuf: viewers know them by name,
and Rerun takes transforms in no other form. Lengths and positions in m; turns as quaternions
(x, y, z, w); colours as (r, g, b, a) from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Literal, NamedTuple, TypeAlias

from foxglove import messages as well_known

from shared.clock import NS_PER_S
from shared.messages import Vector3

Quaternion: TypeAlias = tuple[float, float, float, float]
Colour: TypeAlias = tuple[float, float, float, float]

ENCODING: Final = "protobuf"
"""Of the messages."""
TRANSFORMS: Final = well_known.FrameTransforms.get_schema()
SCENE: Final = well_known.SceneUpdate.get_schema()

ORIGIN: Final[Vector3] = (0.0, 0.0, 0.0)
UPRIGHT: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)


class FrameTransform(NamedTuple):
    """A frame in its parent."""

    parent: str
    child: str
    at: Vector3
    turn: Quaternion


class Solid(NamedTuple):
    """A body in its frame, not turned; a cylinder stands along z."""

    form: Literal["cube", "cylinder", "sphere"]
    size: Vector3
    """Along x, y and z: the diameter, where it is round."""
    colour: Colour
    at: Vector3 = ORIGIN
    """Of its middle."""


class Arrow(NamedTuple):
    """An arrow in its frame."""

    at: Vector3
    """Of its tail."""
    turn: Quaternion
    """From x to where it points."""
    length: float
    width: float
    """Of the shaft."""
    colour: Colour


class Entity(NamedTuple):
    """What moves with a frame, until it is replaced by an entity of its name."""

    frame: str
    name: str
    solids: tuple[Solid, ...] = ()
    arrows: tuple[Arrow, ...] = ()


def transforms(ns: int, rows: Iterable[FrameTransform]) -> bytes:
    """Encode where frames are at a time of ns since 1970."""
    when = _time(ns)
    return well_known.FrameTransforms(
        transforms=[
            well_known.FrameTransform(
                timestamp=when,
                parent_frame_id=row.parent,
                child_frame_id=row.child,
                translation=_vector(row.at),
                rotation=_turn(row.turn),
            )
            for row in rows
        ]
    ).encode()


def scene(ns: int, entities: Iterable[Entity]) -> bytes:
    """Encode entities, each in place of the one of its name, at a time of ns since 1970."""
    when = _time(ns)
    return well_known.SceneUpdate(entities=[_entity(when, row) for row in entities]).encode()


def _entity(when: well_known.Timestamp, row: Entity) -> well_known.SceneEntity:
    return well_known.SceneEntity(
        timestamp=when,
        frame_id=row.frame,
        id=row.name,
        lifetime=well_known.Duration(0),  # it stays
        frame_locked=True,
        arrows=[_arrow(arrow) for arrow in row.arrows],
        cubes=[
            well_known.CubePrimitive(
                pose=_pose(solid.at), size=_vector(solid.size), color=_colour(solid.colour)
            )
            for solid in row.solids
            if solid.form == "cube"
        ],
        spheres=[
            well_known.SpherePrimitive(
                pose=_pose(solid.at), size=_vector(solid.size), color=_colour(solid.colour)
            )
            for solid in row.solids
            if solid.form == "sphere"
        ],
        cylinders=[
            well_known.CylinderPrimitive(
                pose=_pose(solid.at),
                size=_vector(solid.size),
                bottom_scale=1.0,
                top_scale=1.0,
                color=_colour(solid.colour),
            )
            for solid in row.solids
            if solid.form == "cylinder"
        ],
    )


def _arrow(arrow: Arrow) -> well_known.ArrowPrimitive:
    head = min(arrow.length, 3.0 * arrow.width)
    return well_known.ArrowPrimitive(
        pose=_pose(arrow.at, arrow.turn),
        shaft_length=arrow.length - head,
        shaft_diameter=arrow.width,
        head_length=head,
        head_diameter=2.0 * arrow.width,
        color=_colour(arrow.colour),
    )


def _time(ns: int) -> well_known.Timestamp:
    return well_known.Timestamp(*divmod(ns, NS_PER_S))


def _pose(at: Vector3, turn: Quaternion = UPRIGHT) -> well_known.Pose:
    return well_known.Pose(position=_vector(at), orientation=_turn(turn))


def _vector(values: Vector3) -> well_known.Vector3:
    x, y, z = values
    return well_known.Vector3(x=x, y=y, z=z)


def _turn(values: Quaternion) -> well_known.Quaternion:
    x, y, z, w = values
    return well_known.Quaternion(x=x, y=y, z=z, w=w)


def _colour(values: Colour) -> well_known.Color:
    r, g, b, a = values
    return well_known.Color(r=r, g=g, b=b, a=a)
